//! `--budget` for streams of version 3: no calibration is needed, for the coarser levels tell what the finer ones will
//! take.

use std::path::Path;
use std::time::{Duration, Instant};

use b2p::container::version;
use b2p::gaussians::Gaussians;
use b2p::log::Log;
use b2p::renderer::camera::Camera;
use b2p::renderer::{Image, Renderer};
use b2p::{Limits, container::Header};

use super::args::{DetailArg, ModelArg};
use super::budget::BudgetArgs;
use super::pipe::PIPE;
use super::table::milliseconds;
use super::{Failure, Result, load};

/// What is expected must keep the time with so much to spare.
const MARGIN: f64 = 1.1;

/// Gaussians that were chosen to keep a time.
pub struct Kept {
    pub gaussians: Gaussians,
    pub level: u8,
    time: Duration,
    /// Whether they were expected to keep it.
    expected: bool,
}

impl Kept {
    /// What was chosen, and whether the time was kept by what took `took`.
    pub fn describe(&self, took: Duration) -> String {
        let kept = if took <= self.time { "kept" } else { "not kept" };
        let promise = match self.expected {
            true => String::new(),
            false => format!(", which was not expected to take {}", milliseconds(self.time)),
        };
        let (took, time) = (milliseconds(took), milliseconds(self.time));
        format!("budget: level {}{promise}; {kept}: {took} of {time}\n", self.level)
    }
}

/// The bytes of a file, if a budget is asked for and it is a stream of version 3.
pub fn stream(args: &BudgetArgs, input: &Path, limits: &Limits) -> Result<Option<Vec<u8>>> {
    if !args.is_given() || input == Path::new(PIPE) {
        return Ok(None);
    }
    let bytes = load::bytes(input, limits)?;
    if version(&bytes) != Some(3) {
        return Ok(None);
    }
    if args.min_psnr.is_some() || args.calibrate {
        let what = "--min-psnr and --calibrate are for learned streams (version 2)";
        return Err(Failure(format!("{}: {what}", input.display())));
    }
    Ok(Some(bytes))
}

/// Decodes to the finest level whose Gaussians are there in time, the base level at least.
pub fn decode(
    args: &BudgetArgs,
    input: &Path,
    bytes: &[u8],
    model: &ModelArg,
    limits: &Limits,
    log: &Log,
) -> Result<Kept> {
    let time = args.budget.unwrap_or(Duration::MAX);
    let (fail, start) = (Failure::in_file(input), Instant::now());
    let decoder = load::decoder(bytes, &no_detail(), model, limits)?.with_log(log);
    let header = Header::parse(bytes, limits).map_err(&fail)?;
    let voxels = |level: u8| header.voxels(level).map(f64::from);
    let mut decoding = decoder.start();
    decoding.push(bytes);
    let (mut spent, mut per_gaussian) = (Duration::ZERO, None);
    let mut expected = false;
    loop {
        let begun = Instant::now();
        let Some(level) = decoding.advance().map_err(&fail)? else {
            break;
        };
        spent = begun.elapsed().max(spent);
        let here = voxels(level).map_err(&fail)?;
        let each = match per_gaussian {
            Some(each) => each,
            None => {
                let begun = Instant::now();
                decoding.gaussians().map_err(&fail)?;
                *per_gaussian.insert(begun.elapsed().as_secs_f64() / here)
            }
        };
        let left = |more: f64| {
            let all = start.elapsed().as_secs_f64() + more * MARGIN;
            all <= time.as_secs_f64()
        };
        expected = left(each * here);
        if level == header.top {
            break;
        }
        let next = voxels(level + 1).map_err(&fail)?;
        let exact = spent.as_secs_f64() * next / here;
        if !left(exact + each * next) {
            break;
        }
    }
    let level = decoding.level().unwrap_or(header.base);
    let gaussians = decoding.gaussians().map_err(&fail)?;
    Ok(Kept {
        gaussians,
        level,
        time,
        expected,
    })
}

/// Decodes to the finest level whose Gaussians are drawn in time, as seen by this camera, the base level at least.
pub fn draw(
    args: &BudgetArgs,
    input: &Path,
    bytes: &[u8],
    model: &ModelArg,
    camera: &Camera,
    limits: &Limits,
    log: &Log,
) -> Result<Kept> {
    let time = args.budget.unwrap_or(Duration::MAX);
    let fail = Failure::in_file(input);
    let decoder = load::decoder(bytes, &no_detail(), model, limits)?.with_log(log);
    let header = Header::parse(bytes, limits).map_err(&fail)?;
    let mut renderer = Renderer::new()
        .with_isa(load::isa(model.isa.as_deref())?)
        .with_limits(limits.clone());
    let mut image = Image::default();
    let mut decoding = decoder.start();
    decoding.push(bytes);
    let mut best = None;
    while let Some(level) = decoding.advance().map_err(&fail)? {
        let gaussians = decoding.gaussians().map_err(&fail)?;
        let mut least = Duration::MAX;
        // The first picture warms up.
        for _ in 0..3 {
            let drawn = renderer.render_into(&gaussians, camera, &mut image)?;
            least = least.min(drawn.times.total());
        }
        let expected = least.mul_f64(MARGIN) <= time;
        if best.is_some() && !expected {
            break;
        }
        let kept = Kept {
            gaussians,
            level,
            time,
            expected,
        };
        best = Some(kept);
        if !expected || level == header.top {
            break;
        }
    }
    best.ok_or_else(|| Failure(format!("{}: no level is whole", input.display())))
}

fn no_detail() -> DetailArg {
    DetailArg {
        level: None,
        heads: None,
        per_voxel: None,
    }
}
