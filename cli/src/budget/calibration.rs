//! What each step costs on this machine, measured once and kept.

use std::io::Read;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::choice::CalibrationInput;
use super::measure::measure;
use b2p::latents::network::{Head, Model};
use b2p::metrics::Machine;
use b2p::output;
use b2p::{Error, Result};

/// What is longer is no calibration.
const MOST_BYTES: u64 = 1 << 16;
/// So are more entries, and numbers above this.
const MOST_ENTRIES: usize = 256;
const MOST: f64 = 1e12;

/// What decoding and drawing cost, in nanoseconds, as in a process that does it once: threads have just started, memory
/// is fresh from the system, and nothing is ready.
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
    /// Nanoseconds that threads take to start, once a process.
    pub start: f64,
    /// Of each role, what its level costs in the exact zone.
    pub exact: Vec<LevelCost>,
    /// Each role, set of heads, precision and quality.
    pub draws: Vec<DrawCost>,
}

/// What a level costs in nanoseconds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct LevelCost {
    /// However many there are: what has to be got ready, and what is done by steps.
    pub once: f64,
    /// For each voxel.
    pub per_voxel: f64,
}

/// What a picture costs in nanoseconds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct PictureCost {
    /// However much is drawn.
    pub once: f64,
    /// For each Gaussian.
    pub per_gaussian: f64,
    /// For each pixel …
    pub per_pixel: f64,
    /// … and how much more if the surface that is drawn has as much area as a face of the cube.
    pub per_face: f64,
}

/// What pictures took in nanoseconds.
#[derive(Debug, Clone, Copy)]
pub(super) struct PictureTimes {
    /// Few Gaussians, and many.
    pub gaussians: [f64; 2],
    /// The area of the surface of both, in faces of the cube.
    pub faces: [f64; 2],
    /// Few pixels, and many.
    pub pixels: [f64; 2],
    /// Few and many Gaussians, of both few and many pixels.
    pub drawn: [[f64; 2]; 2],
    /// Many pixels, and nothing on them.
    pub empty: f64,
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
    /// To generate the Gaussians of a level, its heads not being ready.
    pub generate: LevelCost,
    /// To draw a picture.
    pub draw: PictureCost,
    /// PSNR in dB against the finest level in double precision.
    pub psnr: f64,
}

impl LevelCost {
    /// From few voxels and the nanoseconds that they took, and many: what lies between is interpolated. Where the
    /// second are not more, or did not take longer, all is the voxels' cost.
    pub fn through(few: [f64; 2], many: [f64; 2]) -> LevelCost {
        let per_voxel = (many[1] - few[1]) / (many[0] - few[0]);
        if many[0] > few[0] && per_voxel >= 0.0 {
            // Few may take less than their share, of many that no longer fit the caches.
            let once = (few[1] - per_voxel * few[0]).max(0.0);
            return LevelCost { once, per_voxel };
        }
        let longer = if few[1] > many[1] { few } else { many };
        LevelCost {
            once: 0.0,
            per_voxel: longer[1] / longer[0].max(1.0),
        }
    }

    /// Nanoseconds of so many voxels.
    pub fn of(&self, voxels: f64) -> f64 {
        self.once + self.per_voxel * voxels
    }
}

impl PictureCost {
    /// The cost by which none of the pictures took more than it says, but for an empty one.
    pub(super) fn from_times(times: &PictureTimes) -> PictureCost {
        let PictureTimes {
            gaussians,
            faces,
            pixels,
            drawn,
            empty,
        } = *times;
        let slope = |by: f64, rise: f64| if by > 0.0 { (rise / by).max(0.0) } else { 0.0 };
        let per_pixel = empty / pixels[1].max(1.0);
        let more = |i: usize| {
            let each = slope(pixels[1] - pixels[0], drawn[i][1] - drawn[i][0]);
            slope(faces[i], each - per_pixel)
        };
        let mut cost = PictureCost {
            once: 0.0,
            per_gaussian: slope(gaussians[1] - gaussians[0], drawn[1][0] - drawn[0][0]),
            per_pixel,
            per_face: more(0).max(more(1)),
        };
        for i in 0..2 {
            for (pixels, time) in pixels.into_iter().zip(drawn[i]) {
                cost.once += (time - cost.of(gaussians[i], faces[i], pixels)).max(0.0);
            }
        }
        cost
    }

    /// Nanoseconds of a picture of so many Gaussians on a surface with the area of so many faces of the cube.
    pub fn of(&self, gaussians: f64, faces: f64, pixels: f64) -> f64 {
        self.once + self.per_gaussian * gaussians + (self.per_pixel + self.per_face * faces) * pixels
    }
}

impl Calibration {
    /// Measures with a stream and its model, with as many threads as the rayon pool that the caller is in has; `say`
    /// receives what is being done.
    ///
    /// # Errors
    /// Those of [`LatentDecoder::decode`](b2p::latents::LatentDecoder::decode) and
    /// [`Renderer::render`](b2p::renderer::Renderer::render); [`Error::Usage`] if no level has Gaussians, or threads
    /// cannot be started.
    pub fn measure(subject: &CalibrationInput<'_>, say: &dyn Fn(&str)) -> Result<Calibration> {
        measure(subject, say)
    }

    /// Where the user's calibration for a model and a number of threads is kept: under `XDG_CACHE_HOME`, or `.cache` at
    /// home. None where neither is known.
    pub fn path(model: &Model) -> Option<PathBuf> {
        let absolute = |name: &str| {
            let path = PathBuf::from(std::env::var_os(name)?);
            path.is_absolute().then_some(path)
        };
        let cache = absolute("XDG_CACHE_HOME").or_else(|| Some(absolute("HOME")?.join(".cache")))?;
        let model_name = model_name(model);
        let (isa, threads) = (model.isa(), rayon::current_num_threads());
        let name = format!("calibration-{}-{isa}-{threads}.json", &model_name[..8]);
        Some(cache.join("b2p").join(name))
    }

    /// What was kept at `path`, if it is of this machine, this version of the program, this model, and as many threads
    /// as there are now. Anything else is none, whatever it is.
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
                d.generate.once,
                d.generate.per_voxel,
                d.draw.once,
                d.draw.per_gaussian,
                d.draw.per_pixel,
                d.draw.per_face,
                d.psnr.abs(),
            ]
        });
        let exact = self.exact.iter().flat_map(|cost| [cost.once, cost.per_voxel]);
        let mut numbers = numbers.chain(exact).chain([self.start]);
        self.draws.len() <= MOST_ENTRIES
            && self.exact.len() <= MOST_ENTRIES
            && numbers.all(|n| (0.0..=MOST).contains(&n))
    }
}

pub(super) fn model_name(model: &Model) -> String {
    model.id().iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use b2p::latents::network::{Shape, untrained};

    const LINE: LevelCost = LevelCost {
        once: 2.0,
        per_voxel: 1.5,
    };

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
            start: 1.0,
            exact: vec![LINE; 3],
            draws: Vec::new(),
        }
    }

    #[test]
    fn a_level_costs_what_few_and_many_voxels_took_and_never_less_than_a_voxels_share() {
        let cost = LevelCost::through([10.0, 120.0], [110.0, 320.0]);
        assert_eq!((cost.once, cost.per_voxel), (100.0, 2.0));
        let steep = LevelCost::through([10.0, 10.0], [110.0, 310.0]);
        assert_eq!((steep.once, steep.per_voxel), (0.0, 3.0));
        for odd in [
            LevelCost::through([10.0, 500.0], [110.0, 320.0]),
            LevelCost::through([10.0, 500.0], [10.0, 320.0]),
        ] {
            assert_eq!(odd.of(10.0), 500.0);
        }
        assert_eq!(LevelCost::through([0.0, 0.0], [0.0, 0.0]).of(7.0), 0.0);
    }

    #[test]
    fn no_picture_took_more_than_its_cost_says() {
        let cost = PictureCost {
            once: 7.0,
            per_gaussian: 2.0,
            per_pixel: 3.0,
            per_face: 4.0,
        };
        let mut times = PictureTimes {
            gaussians: [100.0, 1100.0],
            faces: [1.5, 1.5],
            pixels: [10.0, 60.0],
            drawn: [[0.0; 2]; 2],
            empty: 180.0,
        };
        let PictureTimes { gaussians, pixels, .. } = times;
        times.drawn = gaussians.map(|g| pixels.map(|p| cost.of(g, 1.5, p)));
        assert_eq!(PictureCost::from_times(&times), cost);
        for (drawn, faces) in [
            ([[5.0, 1.0], [9.0, 4.0]], [1.0, 2.0]),
            ([[9.0, 14.0], [3.0, 4.0]], [1.0, 0.0]),
            ([[0.0, 900.0], [300.0, 350.0]], [2.0, 1.0]),
        ] {
            let times = PictureTimes { drawn, faces, ..times };
            let cost = PictureCost::from_times(&times);
            for i in 0..2 {
                for (p, time) in pixels.into_iter().zip(drawn[i]) {
                    let said = cost.of(gaussians[i], faces[i], p);
                    assert!(said >= time, "{cost:?}: {said} of {time}");
                }
            }
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
            |c| c.exact[0].per_voxel = -1.0,
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
