//! What decoding and drawing cost, measured as a process that does it once has it: threads have just started, memory is
//! fresh from the system, networks and renderers are new.
//!
//! Everything is measured in rounds, and medians count: a task that runs once is as likely to take longer. Time in which
//! threads waited for a processor does not count, where the system tells it.

use std::time::{Duration, Instant};

use b2p::container::Header;
use b2p::gaussians::{Gaussians, HeadSet};
use b2p::metrics::{Machine, give_back};
use b2p::renderer::Renderer;
use b2p::renderer::camera::Camera;
use b2p::{Decoder, Error, Isa, Limits, Result};

use super::calibration::{Calibration, CalibrationKey, HeadsCost};
use super::costs::{Curve, PictureCost, PictureSize};

/// Rounds, unless they take longer than [`PATIENCE`]: then at least two.
const ROUNDS: usize = 5;
const PATIENCE: Duration = Duration::from_secs(5);
/// Sides of the pictures whose times tell what a Gaussian and what a pixel costs.
const SIDES: [u32; 2] = [320, 1024];

/// What to measure with.
pub struct Sample<'a> {
    /// Streams, the one of the fewest voxels first: small levels cost more a voxel than large ones.
    pub streams: &'a [Vec<u8>],
    /// Makes a decoder of it with a freshly loaded model.
    pub decoder: &'a dyn Fn() -> Result<Decoder>,
    /// What heads there are.
    pub heads: &'a [HeadSet],
    /// Instructions.
    pub isa: Isa,
    /// Limits of decoding and drawing.
    pub limits: &'a Limits,
}

/// The times that something took, in nanoseconds, one a round.
#[derive(Clone, Default)]
struct Times(Vec<f64>);

impl Times {
    fn median(&self) -> f64 {
        let mut sorted = self.0.clone();
        sorted.sort_by(f64::total_cmp);
        sorted.get(sorted.len() / 2).copied().unwrap_or_default()
    }

    /// How many times the median the longest is.
    fn spread(&self) -> f64 {
        let longest = self.0.iter().copied().fold(0.0, f64::max);
        longest / self.median().max(1.0)
    }
}

/// Those of a set of heads.
#[derive(Clone, Default)]
struct HeadsTimes {
    generate: Times,
    draw: [Times; 2],
    gaussians: usize,
}

/// Those of a level of a stream.
struct LevelTimes<'a> {
    stream: &'a [u8],
    level: u8,
    voxels: f64,
    wide: bool,
    exact: Times,
    heads: Vec<HeadsTimes>,
}

impl<'a> LevelTimes<'a> {
    /// None yet, of all levels of a stream.
    fn of_stream(sample: &Sample<'_>, stream: &'a [u8]) -> Result<Vec<Self>> {
        let header = Header::parse(stream, sample.limits)?;
        let of_level = |level| {
            Ok(LevelTimes {
                stream,
                level,
                voxels: f64::from(header.voxels(level)?),
                wide: header.bits - level > 1,
                exact: Times::default(),
                heads: vec![HeadsTimes::default(); sample.heads.len()],
            })
        };
        let levels = (sample.decoder)()?.levels(stream)?;
        levels.into_iter().map(of_level).collect()
    }
}

/// Measures with as many threads as the rayon pool that the caller is in has; `say` receives what is being done.
///
/// # Errors
/// Those of decoding and drawing; [`Error::Usage`] if threads cannot be started.
pub fn measure(sample: &Sample<'_>, key: CalibrationKey, say: &dyn Fn(&str)) -> Result<Calibration> {
    let levels = sample
        .streams
        .iter()
        .map(|stream| LevelTimes::of_stream(sample, stream));
    let mut all = levels
        .collect::<Result<Vec<_>>>()?
        .into_iter()
        .flatten()
        .collect::<Vec<_>>();
    let (mut empty, start) = ([Times::default(), Times::default()], Instant::now());
    for round in 0..ROUNDS {
        if round > 1 && start.elapsed() > PATIENCE {
            break;
        }
        say(&format!("calibrate: round {} of {ROUNDS}", round + 1));
        for times in &mut all {
            measure_level(sample, times)?;
        }
        for (side, times) in SIDES.into_iter().zip(&mut empty) {
            times.0.push(draw(sample, &Gaussians::default(), side)?);
        }
    }
    calibration(sample, key, &all, empty.map(|times| times.median()))
}

/// One round of a level.
fn measure_level(sample: &Sample<'_>, times: &mut LevelTimes<'_>) -> Result<()> {
    let decoder = (sample.decoder)()?.with_level(times.level);
    let (exact, mut decoding) = cold(|| {
        let decoding = decoder.whole(times.stream)?;
        // The filter of its colours is part of them.
        decoding.points();
        Ok(decoding)
    })?;
    times.exact.0.push(exact);
    for (&heads, times) in sample.heads.iter().zip(&mut times.heads) {
        decoding.set_heads(heads)?;
        let (generate, gaussians) = cold(|| decoding.gaussians())?;
        times.generate.0.push(generate);
        times.gaussians = gaussians.len();
        for (side, times) in SIDES.into_iter().zip(&mut times.draw) {
            times.0.push(draw(sample, &gaussians, side)?);
        }
    }
    Ok(())
}

/// How many times the median the longest of the rounds is: the median of all that was measured.
fn spread(all: &[LevelTimes<'_>]) -> f64 {
    let of_heads = |times: &HeadsTimes| [&times.generate, &times.draw[0], &times.draw[1]].map(Times::spread);
    let of_level = |times: &LevelTimes<'_>| {
        let heads = times.heads.iter().flat_map(of_heads);
        heads.chain([times.exact.spread()]).collect::<Vec<_>>()
    };
    Times(all.iter().flat_map(of_level).collect()).median()
}

/// What was measured, in terms of voxels, Gaussians and pixels.
fn calibration(
    sample: &Sample<'_>,
    key: CalibrationKey,
    all: &[LevelTimes<'_>],
    empty: [f64; 2],
) -> Result<Calibration> {
    let mut calibration = Calibration {
        machine: Machine::this(),
        isa: key.isa,
        threads: rayon::current_num_threads(),
        model: key.model,
        spread: spread(all),
        exact: Curve::default(),
        heads: Vec::new(),
    };
    let per_unit = camera(SIDES[1])?.pixels_per_unit() / f64::from(SIDES[1]);
    for times in all {
        let voxels = times.voxels;
        calibration.exact.push(voxels, times.exact.median());
        let sizes = SIDES.map(|side| {
            let side = f64::from(side);
            PictureSize::of_surface(side * side, per_unit * side, voxels, times.level)
        });
        for (&heads, of_heads) in sample.heads.iter().zip(&times.heads) {
            let gaussians = of_heads.gaussians as f64;
            let mut same = calibration.heads.iter_mut();
            let known = same.find(|cost| cost.heads == heads && cost.wide == times.wide);
            let mut generate = known.as_ref().map_or(Curve::default(), |cost| cost.generate.clone());
            generate.push(voxels, of_heads.generate.median());
            let drawn = of_heads.draw.each_ref().map(Times::median);
            // Pictures of the finest level of the kind have the most Gaussians.
            let cost = HeadsCost {
                heads,
                wide: times.wide,
                per_voxel: gaussians / voxels.max(1.0),
                generate,
                picture: PictureCost::from_times(gaussians, sizes, drawn, empty),
            };
            match known {
                Some(known) => *known = cost,
                None => calibration.heads.push(cost),
            }
        }
    }
    Ok(calibration)
}

/// Nanoseconds of `run`, with new threads and fresh memory, and its result. Time in which its threads could have run,
/// but other programs did, is taken out.
fn cold<T: Send>(run: impl FnOnce() -> Result<T> + Send) -> Result<(f64, T)> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(rayon::current_num_threads());
    let pool = pool
        .build()
        .map_err(|e| Error::Usage(format!("no threads to calibrate with: {e}")))?;
    give_back();
    let before = pool.broadcast(|_| Scheduled::now());
    let (time, made) = pool.install(|| {
        let start = Instant::now();
        let made = run()?;
        Result::Ok((start.elapsed().as_nanos() as f64, made))
    })?;
    let after = pool.broadcast(|_| Scheduled::now());
    Ok((time * undisturbed(&before, &after), made))
}

/// How long a thread has run and waited for a processor, in nanoseconds.
#[derive(Clone, Copy, Default)]
struct Scheduled {
    ran: u64,
    waited: u64,
}

impl Scheduled {
    /// Of the thread that asks; zeros where the system does not tell.
    fn now() -> Scheduled {
        let text = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap_or_default();
        let mut numbers = text.split_ascii_whitespace().map(|n| n.parse().unwrap_or_default());
        let mut next = || numbers.next().unwrap_or_default();
        Scheduled {
            ran: next(),
            waited: next(),
        }
    }
}

/// The share of the time that these threads had a processor when they asked for one: with fewer other programs they
/// would have taken so much of it.
fn undisturbed(before: &[Scheduled], after: &[Scheduled]) -> f64 {
    let sum = |of: fn(&Scheduled) -> u64| {
        let [before, after] = [before, after].map(|all| all.iter().map(of).sum::<u64>());
        after.saturating_sub(before) as f64
    };
    let (ran, waited) = (sum(|s| s.ran), sum(|s| s.waited));
    if ran > 0.0 { ran / (ran + waited) } else { 1.0 }
}

fn camera(side: u32) -> Result<Camera> {
    Camera::orbit(20.0, 20.0, 2.6, 45.0, side, side)
}

/// Nanoseconds of a picture by a new renderer.
fn draw(sample: &Sample<'_>, gaussians: &Gaussians, side: u32) -> Result<f64> {
    let camera = camera(side)?;
    let (isa, limits) = (sample.isa, sample.limits);
    let (time, _) = cold(|| {
        let renderer = Renderer::new().with_isa(isa);
        renderer.with_limits(limits.clone()).render(gaussians, &camera)
    })?;
    Ok(time)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_round_of_three_that_took_long_tells_of_the_spread_alone() {
        let times = Times(vec![2.0, 90.0, 1.0]);
        assert_eq!((times.median(), times.spread()), (2.0, 45.0));
    }

    #[test]
    fn time_that_other_programs_took_is_taken_out() {
        let of = |ran, waited| Scheduled { ran, waited };
        let before = [of(100, 50), of(200, 0)];
        assert_eq!(undisturbed(&before, &[of(200, 50), of(300, 0)]), 1.0);
        assert_eq!(undisturbed(&before, &[of(200, 150), of(300, 100)]), 0.5);
        assert_eq!(undisturbed(&[of(0, 0)], &[of(0, 0)]), 1.0, "where nothing is known");
    }
}
