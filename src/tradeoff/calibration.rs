//! What each step costs on this machine, measured once and kept.

use std::io::Read;
use std::path::{Path, PathBuf};
use std::time::Instant;

use serde::{Deserialize, Serialize};

use super::Subject;
use super::machine::Machine;
use super::metrics::{pixels_apart, psnr};
use super::spread::Spread;
use super::truth::in_double;
use crate::bitstream::Header;
use crate::decoder::Decoder;
use crate::error::{Error, Result};
use crate::gaussians::{Frame, Gaussians, activate};
use crate::geometry::{KernelMap, Voxels};
use crate::log::{Log, Step};
use crate::network::{Head, Heads, Model, Precision};
use crate::output;
use crate::pixels::reference::{self, Cutoffs};
use crate::pixels::{Background, Image, Quality, Renderer};
use crate::projection::Camera;

/// Times that everything is measured; medians count.
const REPEATS: usize = 3;
/// Sides of the pictures whose times tell what a Gaussian and what a pixel costs; the smaller one's accuracy is measured.
const SIDES: [u32; 2] = [320, 1024];
/// The renderer's qualities by name.
const QUALITIES: [(&str, Quality); 3] = [
    ("fast", Quality::Fast),
    ("fine", Quality::Fine),
    ("exact", Quality::Exact),
];
/// The accuracy, in dB, of pictures that are equal.
const EQUAL: f64 = 200.0;
/// What is longer is no calibration.
const MOST_BYTES: u64 = 1 << 16;
/// So are more entries, and numbers above this.
const MOST_ENTRIES: usize = 256;
const MOST: f64 = 1e12;

/// What decoding and drawing cost, in nanoseconds, as when it is done once: memory is new, and nothing is in the caches.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// Where it was measured.
    pub machine: Machine,
    /// With which instructions.
    pub isa: String,
    /// With how many threads.
    pub threads: usize,
    /// With which model: its id, hexadecimal.
    pub model: String,
    /// With which heads: streams of a model have one id with any.
    pub gg: Vec<Head>,
    /// Of each role, what a voxel of its level costs in the exact zone.
    pub exact: Vec<f64>,
    /// Each role, set of heads, precision and quality.
    pub draws: Vec<DrawCost>,
}

/// What Gaussians and pictures of one role, set of heads, precision and quality cost.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DrawCost {
    /// How far the level lies above the base level.
    pub role: usize,
    /// Gaussians for each voxel.
    pub children: u8,
    /// What generates Gaussians.
    pub heads: String,
    /// Precision of the network.
    pub precision: String,
    /// Quality of the renderer.
    pub quality: String,
    /// Nanoseconds to get the heads ready, once a model …
    pub prepare: f64,
    /// … and to generate the Gaussians of a voxel.
    pub generate: f64,
    /// Nanoseconds to draw, for each Gaussian …
    pub per_gaussian: f64,
    /// … and for each pixel.
    pub per_pixel: f64,
    /// PSNR in dB against the finest level in double precision.
    pub psnr: f64,
}

impl Calibration {
    /// Measures with a stream and its model, on the rayon pool that the caller is in; `say` is told what is being done.
    ///
    /// # Errors
    /// Those of [`Decoder::decode`](crate::decoder::Decoder::decode) and
    /// [`Renderer::render`](crate::pixels::Renderer::render); [`Error::Usage`] if no level has Gaussians.
    pub fn measure(subject: &Subject<'_>, say: &dyn Fn(&str)) -> Result<Calibration> {
        let header = Header::parse(subject.stream, subject.limits)?;
        let model = (subject.model)()?;
        let decoder = Decoder::new(&model).with_limits(subject.limits.clone());
        let levels = decoder.levels(subject.stream)?;
        let Some(&finest) = levels.last() else {
            return Err(Error::Usage(
                "the stream has no level with Gaussians".into(),
            ));
        };
        say("calibrate: the truth");
        let truth = in_double(subject, &model, finest)?.0;
        let truth = reference::render(&truth, &camera(SIDES[0])?, Background::WHITE, Cutoffs::NONE);
        say("calibrate: levels");
        let mut calibration = Calibration {
            machine: Machine::this(),
            isa: model.isa().to_string(),
            threads: rayon::current_num_threads(),
            model: model_name(&model),
            gg: model.shape().gg.clone(),
            exact: exact_costs(subject, &decoder, &header, finest)?,
            draws: Vec::new(),
        };
        let frame = decoder.frame(subject.stream)?;
        for level in levels {
            let exact = decoder.exact(subject.stream, level, &mut Log::default())?;
            let at = Level {
                map: exact.octree.kernel_map(level),
                role: usize::from(level - header.base),
                voxels: exact.octree.level(level),
                features: &exact.features,
                frame,
            };
            // What a picture costs hardly depends on what generated the Gaussians: the first tells for all.
            let mut costs: Option<[DrawTime; 3]> = None;
            for heads in model.shape().heads() {
                for precision in Precision::ALL {
                    let precise = || (subject.model)()?.with_precision(precision);
                    if precise().is_err() {
                        continue;
                    }
                    say(&format!(
                        "calibrate: level {level}, {heads} heads, {precision}"
                    ));
                    let made = at.generate(&precise, heads)?;
                    let gaussians = &made.gaussians;
                    let costs = match costs {
                        Some(costs) => costs,
                        None => *costs.insert(draw_times(subject, &model, gaussians)?),
                    };
                    for ((name, quality), cost) in QUALITIES.into_iter().zip(costs) {
                        let picture = draw(subject, &model, gaussians, quality, SIDES[0], 1)?.1;
                        calibration.draws.push(DrawCost {
                            role: at.role,
                            children: made.children as u8,
                            heads: heads.to_string(),
                            precision: precision.to_string(),
                            quality: name.into(),
                            prepare: made.prepare,
                            generate: made.per_voxel,
                            per_gaussian: cost.per_gaussian,
                            per_pixel: cost.per_pixel,
                            psnr: psnr(pixels_apart(&truth, &picture).0).min(EQUAL),
                        });
                    }
                }
            }
        }
        Ok(calibration)
    }

    /// Where the user's calibration for a model and a number of threads is kept: under `XDG_CACHE_HOME`, or `.cache` at home. None where
    /// neither is known.
    pub fn path(model: &Model) -> Option<PathBuf> {
        let absolute = |name: &str| {
            let path = PathBuf::from(std::env::var_os(name)?);
            path.is_absolute().then_some(path)
        };
        let cache =
            absolute("XDG_CACHE_HOME").or_else(|| Some(absolute("HOME")?.join(".cache")))?;
        let model_name = model_name(model);
        let (isa, threads) = (model.isa(), rayon::current_num_threads());
        let name = format!("calibration-{}-{isa}-{threads}.json", &model_name[..8]);
        Some(cache.join("b2p").join(name))
    }

    /// What was kept at `path`, if it is of this machine, this version of the program, this model, and as many threads as there are now.
    /// Anything else is none, whatever it is.
    pub fn load(path: &Path, model: &Model) -> Option<Calibration> {
        let about = std::fs::metadata(path).ok()?;
        if !about.is_file() || about.len() > MOST_BYTES {
            return None;
        }
        let mut bytes = Vec::new();
        let file = std::fs::File::open(path).ok()?;
        file.take(MOST_BYTES).read_to_end(&mut bytes).ok()?;
        let found: Calibration = serde_json::from_slice(&bytes).ok()?;
        let fits = found.machine == Machine::this()
            && found.isa == model.isa().to_string()
            && found.threads == rayon::current_num_threads()
            && found.model == model_name(model)
            && found.gg == model.shape().gg;
        (fits && found.is_sound()).then_some(found)
    }

    /// Keeps it.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn save(&self, path: &Path) -> Result<()> {
        let io = |source| Error::Io {
            path: path.to_owned(),
            source,
        };
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder).map_err(io)?;
        }
        let text = serde_json::to_string_pretty(self).map_err(|e| io(e.into()))?;
        output::write_file(path, |w| w.write_all(text.as_bytes()).map_err(io))
    }

    fn is_sound(&self) -> bool {
        let numbers = self.draws.iter().flat_map(|d| {
            [
                d.prepare,
                d.generate,
                d.per_gaussian,
                d.per_pixel,
                d.psnr.abs(),
            ]
        });
        let mut numbers = numbers.chain(self.exact.iter().copied());
        self.draws.len() <= MOST_ENTRIES
            && self.exact.len() <= MOST_ENTRIES
            && numbers.all(|n| (0.0..=MOST).contains(&n))
    }
}

fn model_name(model: &Model) -> String {
    model
        .id()
        .iter()
        .map(|byte| format!("{byte:02x}"))
        .collect()
}

/// Of each role up to the finest level's, what a voxel of its level costs in the exact zone.
fn exact_costs(
    subject: &Subject<'_>,
    decoder: &Decoder<&Model>,
    header: &Header,
    finest: u8,
) -> Result<Vec<f64>> {
    let mut runs = Vec::new();
    for _ in 0..REPEATS {
        let mut log = Log::default();
        decoder.exact(subject.stream, finest, &mut log)?;
        runs.push(log.steps().to_vec());
    }
    let levels = (header.base..=finest).zip(&header.voxels);
    let cost = |(level, &voxels): (u8, &u32)| {
        let ending = format!(" of level {level}");
        let sum = |steps: &Vec<Step>| -> f64 {
            let steps = steps.iter().filter(|step| step.name.ends_with(&ending));
            steps.map(|step| step.time.as_nanos() as f64).sum()
        };
        Spread::of(runs.iter().map(sum)).median / f64::from(voxels.max(1))
    };
    Ok(levels.map(cost).collect())
}

/// A level, decoded in the exact zone.
struct Level<'a> {
    map: KernelMap,
    role: usize,
    voxels: &'a Voxels,
    features: &'a [i16],
    frame: Frame,
}

/// Gaussians of a level, and what they cost in nanoseconds.
struct Made {
    gaussians: Gaussians,
    children: usize,
    /// To get ready for the first voxel.
    prepare: f64,
    per_voxel: f64,
}

impl Level<'_> {
    /// Generates Gaussians, each time with a model as it comes from the file.
    fn generate(&self, model: &dyn Fn() -> Result<Model>, heads: Heads) -> Result<Made> {
        let time = |voxels: &Voxels, features: &[i16], map: &KernelMap| {
            let (mut times, mut made) = (Vec::new(), None);
            for _ in 0..REPEATS {
                let fresh = model()?;
                let head = fresh.shape().head(self.role, heads);
                let children = head.map_or(1, |head| head.children);
                let start = Instant::now();
                let raw = fresh.generate_with(heads, self.role, features, map)?;
                let gaussians = activate(&raw, voxels, children, fresh.shape(), self.frame);
                times.push(start.elapsed().as_nanos() as f64);
                made = Some((gaussians, children));
            }
            Result::Ok((Spread::of(times).median, made.unwrap_or_default()))
        };
        let one = (Voxels::new(0, vec![0]), KernelMap::root());
        let channels = self.features.len() / self.voxels.len().max(1);
        let prepare = time(&one.0, &self.features[..channels], &one.1)?.0;
        let (whole, (gaussians, children)) = time(self.voxels, self.features, &self.map)?;
        Ok(Made {
            gaussians,
            children,
            prepare,
            per_voxel: (whole - prepare).max(0.0) / self.voxels.len().max(1) as f64,
        })
    }
}

/// Nanoseconds that a Gaussian and a pixel take to be drawn.
#[derive(Clone, Copy, Default)]
struct DrawTime {
    per_gaussian: f64,
    per_pixel: f64,
}

/// Of each of [`QUALITIES`], from pictures of two sizes and an empty one. What a line through two noisy times would make too little is made at least
/// as much as they say.
fn draw_times(
    subject: &Subject<'_>,
    model: &Model,
    gaussians: &Gaussians,
) -> Result<[DrawTime; 3]> {
    let [few, many] = SIDES.map(|side| f64::from(side).powi(2));
    let count = gaussians.len().max(1) as f64;
    let empty = Gaussians::default();
    let mut times = [DrawTime::default(); 3];
    for ((_, quality), time) in QUALITIES.into_iter().zip(&mut times) {
        let draw = |of, side| Ok::<_, Error>(draw(subject, model, of, quality, side, REPEATS)?.0);
        let bare = draw(&empty, SIDES[1])? / many;
        let [small, large] = [draw(gaussians, SIDES[0])?, draw(gaussians, SIDES[1])?];
        time.per_pixel = ((large - small) / (many - few)).max(bare);
        let rest = (small - time.per_pixel * few).max(large - time.per_pixel * many);
        time.per_gaussian = (rest / count).max(0.0);
    }
    Ok(times)
}

fn camera(side: u32) -> Result<Camera> {
    Camera::orbit(20.0, 20.0, 2.6, 45.0, side, side)
}

/// The median time of a picture in nanoseconds, each by a renderer of its own; and the picture.
fn draw(
    subject: &Subject<'_>,
    model: &Model,
    gaussians: &Gaussians,
    quality: Quality,
    side: u32,
    repeats: usize,
) -> Result<(f64, Image)> {
    let camera = camera(side)?;
    let mut image = Image::default();
    let mut times = Vec::new();
    for _ in 0..repeats {
        let mut renderer = Renderer::new(model.isa());
        renderer.set_quality(quality);
        let start = Instant::now();
        image = renderer
            .render(gaussians, &camera, Background::WHITE, subject.limits)?
            .0;
        times.push(start.elapsed().as_nanos() as f64);
    }
    Ok((Spread::of(times).median, image))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::{Shape, untrained};

    fn model() -> Model {
        Model::from_bytes(&untrained(&Shape::tiny(), 1)).unwrap()
    }

    fn calibration(model: &Model) -> Calibration {
        Calibration {
            machine: Machine::this(),
            isa: model.isa().to_string(),
            threads: rayon::current_num_threads(),
            model: model_name(model),
            gg: model.shape().gg.clone(),
            exact: vec![1.5; 3],
            draws: Vec::new(),
        }
    }

    #[test]
    fn what_was_kept_is_found_again() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("b2p").join("c.json");
        let model = model();
        let kept = calibration(&model);
        kept.save(&path).unwrap();
        assert_eq!(Calibration::load(&path, &model), Some(kept));
    }

    #[test]
    fn what_is_of_another_machine_model_or_number_of_threads_is_not_taken() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("c.json");
        let model = model();
        let spoil: [fn(&mut Calibration); 7] = [
            |c| c.machine.processor.push('x'),
            |c| c.machine.version.push('x'),
            |c| c.isa.push('x'),
            |c| c.model.push('x'),
            |c| c.gg[0].channels += 4,
            |c| c.threads += 1,
            |c| c.exact[0] = -1.0,
        ];
        for (i, spoil) in spoil.iter().enumerate() {
            let mut kept = calibration(&model);
            spoil(&mut kept);
            kept.save(&path).unwrap();
            assert_eq!(Calibration::load(&path, &model), None, "{i}");
        }
    }

    #[test]
    fn whatever_lies_in_the_cache_is_no_calibration_and_no_harm() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("c.json");
        let model = model();
        assert_eq!(Calibration::load(&path, &model), None, "nothing");
        assert_eq!(Calibration::load(folder.path(), &model), None, "a folder");
        let kept = serde_json::to_string(&calibration(&model)).unwrap();
        let deep = "[".repeat(1 << 15);
        let endless = kept.replace("1.5", "1e999");
        let huge = " ".repeat(1 << 17) + &kept;
        let cut = &kept[..kept.len() / 2];
        for hostile in ["", "{}", "null", "\0\0", &deep, &endless, &huge, cut] {
            std::fs::write(&path, hostile).unwrap();
            assert_eq!(Calibration::load(&path, &model), None, "{:.40}", hostile);
        }
        #[cfg(unix)]
        {
            let link = folder.path().join("zero.json");
            std::os::unix::fs::symlink("/dev/zero", &link).unwrap();
            assert_eq!(Calibration::load(&link, &model), None, "a device");
        }
        let below_a_file = path.join("c.json");
        assert!(calibration(&model).save(&below_a_file).is_err());
    }
}
