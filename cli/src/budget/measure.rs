//! What decoding and drawing cost, measured as a process that does it once has it.
//!
//! Threads have just started, memory is fresh from the system, models are freshly loaded and renderers are new. What is
//! paid however few the voxels are comes from a second stream: the same geometry, some levels coarser.

use std::time::{Duration, Instant};

use b2p::metrics::give_back;

use super::calibration::{Calibration, DrawCost, LevelCost, PictureCost, PictureTimes, model_name};
use super::choice::CalibrationInput;
use super::choice::faces;
use b2p::Limits;
use b2p::container::Header;
use b2p::encoder::with_zero_latents;
use b2p::gaussians::Heads;
use b2p::gaussians::{Frame, Gaussians};
use b2p::geometry::{KernelMap, Octree, Voxels};
use b2p::latents::LatentDecoder;
use b2p::latents::activate;
use b2p::latents::network::Model;
use b2p::layers::Precision;
use b2p::log::{Log, Step};
use b2p::metrics::{Machine, Spread, pixels_apart, psnr};
use b2p::renderer::camera::Camera;
use b2p::renderer::reference::{self, Cutoffs};
use b2p::renderer::{Background, Image, Quality, Renderer};
use b2p::{Error, Result};

/// Times that everything is measured, unless that takes longer than [`PATIENCE`]. The third quartile counts: what is
/// promised on it is to be kept.
const REPEATS: usize = 5;
const PATIENCE: Duration = Duration::from_millis(250);
/// Levels by which the second stream is coarser, if the first has them above its own.
const COARSER: u8 = 3;
/// Sides of the pictures whose times tell what a Gaussian and what a pixel costs; the smaller one's accuracy is
/// measured.
const SIDES: [u32; 2] = [320, 1024];
/// The renderer's qualities by name, the finest last.
const QUALITIES: [(&str, Quality); 3] = [
    ("fast", Quality::Fast),
    ("fine", Quality::Fine),
    ("exact", Quality::Exact),
];
/// The accuracy, in dB, of pictures that are equal.
const EQUAL: f64 = 200.0;

/// [`Calibration::measure`].
pub(super) fn measure(subject: &CalibrationInput<'_>, say: &dyn Fn(&str)) -> Result<Calibration> {
    let header = Header::parse(subject.stream, subject.limits)?;
    let model = (subject.model)()?;
    let decoder = LatentDecoder::new(&model).with_limits(subject.limits.clone());
    let levels = decoder.levels(subject.stream)?;
    let Some(&finest) = levels.last() else {
        return Err(Error::Usage("the stream has no level with Gaussians".into()));
    };
    say("calibrate: levels");
    let (all, octree) = decode_levels(&decoder, subject.stream, header.base, &levels)?;
    let coarser = COARSER.min(header.base);
    let small = without_features(&header, finest, &octree, coarser, &model)?;
    let small_levels: Vec<u8> = levels.iter().map(|level| level - coarser).collect();
    let all_small = decode_levels(&decoder, &small, header.base - coarser, &small_levels)?.0;
    let few = exact_times(subject, &small, finest - coarser)?;
    let many = exact_times(subject, subject.stream, finest)?;
    say("calibrate: the truth");
    let truth = match all.last() {
        Some(level) => level.in_double(&model)?,
        None => Gaussians::default(),
    };
    let truth = reference::render(&truth, &camera(SIDES[0])?, Background::WHITE, Cutoffs::NONE);
    let mut calibration = Calibration {
        machine: Machine::this(),
        isa: model.isa().to_string(),
        threads: rayon::current_num_threads(),
        model: model_name(&model),
        gg: model.shape().gg.clone(),
        start: start_time()?,
        exact: few
            .into_iter()
            .zip(many)
            .map(|(few, many)| LevelCost::through(few, many))
            .collect(),
        draws: Vec::new(),
    };
    let mut precisions = Vec::new();
    for precision in Precision::ALL {
        if (subject.model)()?.with_precision(precision).is_ok() {
            precisions.push(precision);
        }
    }
    for (level, small) in all.iter().zip(&all_small) {
        // What a picture costs hardly depends on what generated the Gaussians: the first tells for all.
        let mut draws: Option<[PictureCost; 3]> = None;
        for heads in model.shape().heads() {
            // Other heads than the best are for who lacks time: one precision is enough.
            let some = if heads == Heads::Best { precisions.len() } else { 1 };
            for &precision in precisions.iter().take(some) {
                let (depth, role) = (level.voxels.depth(), level.role);
                say(&format!("calibrate: level {depth}, {heads} heads, {precision}"));
                let precise = || (subject.model)()?.with_precision(precision);
                let few = small.generate(&precise, heads)?;
                let many = level.generate(&precise, heads)?;
                let gaussians = &many.gaussians;
                let draws = match draws {
                    Some(draws) => draws,
                    None => {
                        let both = [(&few.gaussians, small), (gaussians, level)];
                        *draws.insert(picture_costs(subject.limits, &model, both)?)
                    }
                };
                for ((name, quality), draw) in QUALITIES.into_iter().zip(draws) {
                    let picture = picture(subject.limits, &model, gaussians, quality, SIDES[0])?;
                    calibration.draws.push(DrawCost {
                        role,
                        children: many.children as u8,
                        heads: heads.to_string(),
                        precision: precision.to_string(),
                        quality: name.into(),
                        generate: LevelCost::through(few.time, many.time),
                        draw,
                        psnr: psnr(pixels_apart(&truth, &picture).0).min(EQUAL),
                    });
                }
            }
        }
    }
    Ok(calibration)
}

/// What `run` gives, [`REPEATS`] times or until it has taken [`PATIENCE`].
fn repeated<T>(mut run: impl FnMut() -> Result<T>) -> Result<Vec<T>> {
    let start = Instant::now();
    let mut all = vec![run()?];
    while all.len() < REPEATS && start.elapsed() < PATIENCE {
        all.push(run()?);
    }
    Ok(all)
}

/// As many threads as the caller has, just started.
fn threads() -> Result<rayon::ThreadPool> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(rayon::current_num_threads());
    pool.build()
        .map_err(|e| Error::Usage(format!("no threads to calibrate with: {e}")))
}

/// Runs with new threads and fresh memory.
fn cold<T: Send>(run: impl FnOnce() -> Result<T> + Send) -> Result<T> {
    let pool = threads()?;
    give_back();
    pool.install(run)
}

/// Nanoseconds that threads take to start.
fn start_time() -> Result<f64> {
    let times = repeated(|| {
        let start = Instant::now();
        threads()?.broadcast(|_| ());
        Ok(start.elapsed().as_nanos() as f64)
    });
    Ok(Spread::of(times?).high)
}

/// A stream of as many levels as lead to `finest`, `coarser` levels above them; its latents are zero.
fn without_features(header: &Header, finest: u8, octree: &Octree, coarser: u8, model: &Model) -> Result<Vec<u8>> {
    let [base, top] = [header.base, finest].map(|level| level - coarser);
    let octree = octree.truncated(top);
    let header = Header {
        bits: header.bits - coarser,
        base,
        top,
        points: octree.level(top).len() as u64,
        sections: Vec::new(),
        ..header.clone()
    };
    with_zero_latents(header, octree, model)
}

/// Of each level of a stream down to `finest`, its voxels, and the nanoseconds that it takes in the exact zone.
fn exact_times(subject: &CalibrationInput<'_>, stream: &[u8], finest: u8) -> Result<Vec<[f64; 2]>> {
    let header = Header::parse(stream, subject.limits)?;
    let runs = repeated(|| {
        let model = (subject.model)()?;
        let decoder = LatentDecoder::new(&model).with_limits(subject.limits.clone());
        cold(|| {
            let log = Log::default();
            decoder.exact(stream, finest, &log)?;
            Ok(log.steps())
        })
    })?;
    let levels = (header.base..=finest).zip(&header.voxels);
    let times = levels.map(|(level, &voxels)| {
        let ending = format!(" of level {level}");
        let sum = |steps: &Vec<Step>| -> f64 {
            let steps = steps.iter().filter(|step| step.name.ends_with(&ending));
            steps.map(|step| step.time.as_nanos() as f64).sum()
        };
        [f64::from(voxels), Spread::of(runs.iter().map(sum)).high]
    });
    Ok(times.collect())
}

/// A level, decoded in the exact zone.
struct Level {
    role: usize,
    map: KernelMap,
    voxels: Voxels,
    features: Vec<i16>,
    frame: Frame,
}

/// Gaussians of a level, the voxels that they were generated from, and the nanoseconds that it took.
struct Made {
    gaussians: Gaussians,
    children: usize,
    time: [f64; 2],
}

/// These levels of a stream whose first is `base`, and the octree down to the last.
fn decode_levels(decoder: &LatentDecoder, stream: &[u8], base: u8, levels: &[u8]) -> Result<(Vec<Level>, Octree)> {
    let frame = decoder.frame(stream)?;
    let mut decoding = decoder.start(levels.last().copied());
    decoding.push(stream);
    let (mut all, mut octree) = (Vec::new(), Octree::root());
    while let Some(level) = decoding.advance(&Log::default())? {
        let Some(exact) = decoding.exact().filter(|_| levels.contains(&level)) else {
            continue;
        };
        octree = exact.octree.clone();
        all.push(Level {
            role: usize::from(level - base),
            map: octree.kernel_map(level),
            voxels: octree.level(level).clone(),
            features: exact.features.clone(),
            frame,
        });
    }
    Ok((all, octree))
}

impl Level {
    fn gaussians(&self, model: &Model, heads: Heads, raw: &[f32]) -> Gaussians {
        let children = self.children(model, heads);
        activate(raw, &self.voxels, children, model.shape(), self.frame)
    }

    fn children(&self, model: &Model, heads: Heads) -> usize {
        let head = model.shape().head(self.role, heads);
        head.map_or(1, |head| head.children)
    }

    /// Gaussians as they should be.
    fn in_double(&self, model: &Model) -> Result<Gaussians> {
        let raw = model.generate_in_double(Heads::Best, self.role, &self.features, &self.map)?;
        Ok(self.gaussians(model, Heads::Best, &raw))
    }

    /// Generates Gaussians, each time with a freshly loaded model.
    fn generate(&self, model: &dyn Fn() -> Result<Model>, heads: Heads) -> Result<Made> {
        let runs = repeated(|| {
            let fresh = model()?;
            cold(|| {
                let start = Instant::now();
                let raw = fresh.generate_with(heads, self.role, &self.features, &self.map)?;
                let gaussians = self.gaussians(&fresh, heads, &raw);
                let time = start.elapsed().as_nanos() as f64;
                Ok((time, gaussians, self.children(&fresh, heads)))
            })
        })?;
        let time = Spread::of(runs.iter().map(|(time, ..)| *time)).high;
        let (_, gaussians, children) = runs.into_iter().next_back().unwrap_or_default();
        Ok(Made {
            gaussians,
            children,
            time: [self.voxels.len() as f64, time],
        })
    }
}

/// What pictures of few and many Gaussians cost, of each of [`QUALITIES`], which take turns. An empty one costs the
/// same in all, and none less than a coarser one.
fn picture_costs(limits: &Limits, model: &Model, [few, many]: [(&Gaussians, &Level); 2]) -> Result<[PictureCost; 3]> {
    let empty = Gaussians::default();
    let pictures = [few.0, many.0].map(|gaussians| SIDES.map(|side| (gaussians, side)));
    let mut rounds = [const { [const { Vec::new() }; 5] }; QUALITIES.len()];
    let start = Instant::now();
    for round in 0..REPEATS {
        if round > 0 && start.elapsed() > 4 * PATIENCE {
            break;
        }
        for ((_, quality), runs) in QUALITIES.into_iter().zip(&mut rounds) {
            let pictures = pictures.as_flattened().iter().copied();
            for ((gaussians, side), runs) in pictures.chain([(&empty, SIDES[1])]).zip(runs) {
                runs.push(cold(|| {
                    let start = Instant::now();
                    picture(limits, model, gaussians, quality, side)?;
                    Ok(start.elapsed().as_nanos() as f64)
                })?);
            }
        }
    }
    let area = |level: &Level| faces(level.voxels.len() as f64, level.voxels.depth());
    let empties = rounds.iter().flat_map(|runs| runs[4].iter().copied());
    let mut times = PictureTimes {
        gaussians: [few.0.len() as f64, many.0.len() as f64],
        faces: [area(few.1), area(many.1)],
        pixels: SIDES.map(|side| f64::from(side).powi(2)),
        drawn: [[0.0; 2]; 2],
        empty: Spread::of(empties).high,
    };
    Ok(rounds.map(|runs| {
        for (drawn, runs) in times.drawn.as_flattened_mut().iter_mut().zip(runs) {
            *drawn = drawn.max(Spread::of(runs).high);
        }
        PictureCost::from_times(&times)
    }))
}

fn camera(side: u32) -> Result<Camera> {
    Camera::orbit(20.0, 20.0, 2.6, 45.0, side, side)
}

/// A picture by a new renderer.
fn picture(limits: &Limits, model: &Model, gaussians: &Gaussians, quality: Quality, side: u32) -> Result<Image> {
    let renderer = Renderer::new().with_isa(model.isa()).with_limits(limits.clone());
    renderer.with_quality(quality).render(gaussians, &camera(side)?)
}
