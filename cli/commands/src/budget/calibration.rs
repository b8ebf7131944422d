//! What each step costs on this machine, measured once and kept.

use std::io::Read;
use std::path::{Path, PathBuf};
use std::time::Duration;

use b2p::gaussians::HeadSet;
use b2p::metrics::Machine;
use b2p::output;
use b2p::{Error, Result};
use serde::{Deserialize, Serialize};

use super::costs::{Curve, PictureCost};

/// What is longer is no calibration.
const MOST_BYTES: u64 = 1 << 16;
/// So are numbers above this.
const MOST: f64 = 1e15;
/// One that is plainly off is measured again unless it is younger.
const LEAST_AGE: Duration = Duration::from_secs(600);

/// What it was measured with.
#[derive(Debug, Clone, PartialEq)]
pub struct CalibrationKey {
    /// Instructions.
    pub isa: String,
    /// A name for model and stream.
    pub model: String,
}

/// What decoding and drawing cost, in nanoseconds, as in a process that does it once: threads have just started, memory
/// is fresh from the system, and no network is ready.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// Where it was measured.
    pub machine: Machine,
    /// With which instructions.
    pub isa: String,
    /// With how many threads.
    pub threads: usize,
    /// With which model and stream.
    pub model: String,
    /// How many times its usual time something may take here, as far as the rounds of the measurement tell.
    pub spread: f64,
    /// Decoding to a level, without Gaussians, by the voxels of that level.
    pub exact: Curve,
    /// Each set of heads.
    pub heads: Vec<HeadsCost>,
}

/// What Gaussians and pictures cost with one set of heads.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct HeadsCost {
    /// Which.
    #[serde(with = "heads_name")]
    pub heads: HeadSet,
    /// Whether voxels are more than twice as wide as those of the cloud: heads then make several Gaussians of each.
    pub wide: bool,
    /// Gaussians of a voxel.
    pub per_voxel: f64,
    /// To make the Gaussians of a level, by its voxels.
    pub generate: Curve,
    /// To draw a picture.
    pub picture: PictureCost,
}

/// Names of heads in files.
mod heads_name {
    use b2p::gaussians::HeadSet;
    use serde::{Deserialize, Deserializer, Serializer};

    pub fn serialize<S: Serializer>(heads: &HeadSet, to: S) -> Result<S::Ok, S::Error> {
        to.collect_str(heads)
    }

    pub fn deserialize<'d, D: Deserializer<'d>>(from: D) -> Result<HeadSet, D::Error> {
        let name = String::deserialize(from)?;
        name.parse().map_err(serde::de::Error::custom)
    }
}

impl Calibration {
    /// What heads cost on levels so many above that of the cloud.
    pub fn of_levels_above(&self, above: u8) -> impl Iterator<Item = &HeadsCost> {
        self.heads.iter().filter(move |cost| cost.wide == (above > 1))
    }

    /// Where the user's calibration for a model and a number of threads is kept: under `XDG_CACHE_HOME`, or `.cache` at
    /// home. None where neither is known.
    pub fn path(key: &CalibrationKey) -> Option<PathBuf> {
        let absolute = |name: &str| {
            let path = PathBuf::from(std::env::var_os(name)?);
            path.is_absolute().then_some(path)
        };
        let cache = absolute("XDG_CACHE_HOME").or_else(|| Some(absolute("HOME")?.join(".cache")))?;
        let (isa, threads) = (&key.isa, rayon::current_num_threads());
        let name = format!("calibration-{}-{isa}-{threads}.json", key.model);
        Some(cache.join("b2p").join(name))
    }

    /// Whether what is kept at `path` is old enough to be measured again.
    pub fn may_be_retaken(path: &Path) -> bool {
        let changed = std::fs::metadata(path).and_then(|about| about.modified());
        let age = changed.ok().and_then(|at| at.elapsed().ok());
        age.is_none_or(|age| age >= LEAST_AGE)
    }

    /// What was kept at `path`, if it is of this machine, this version of the program, this key, and as many threads
    /// as there are now. Anything else is none, whatever it is.
    pub fn load(path: &Path, key: &CalibrationKey) -> Option<Calibration> {
        let about = std::fs::metadata(path).ok()?;
        if !about.is_file() || about.len() > MOST_BYTES {
            return None;
        }
        let mut bytes = Vec::new();
        let file = std::fs::File::open(path).ok()?;
        file.take(MOST_BYTES).read_to_end(&mut bytes).ok()?;
        let found: Calibration = serde_json::from_slice(&bytes).ok()?;
        let fits = found.machine == Machine::this()
            && found.isa == key.isa
            && found.threads == rayon::current_num_threads()
            && found.model == key.model;
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
        let of_heads = |cost: &HeadsCost| {
            let own = cost.picture.numbers().into_iter().chain([cost.per_voxel]);
            own.chain(cost.generate.numbers()).collect::<Vec<_>>()
        };
        let numbers = self
            .exact
            .numbers()
            .chain([self.spread])
            .chain(self.heads.iter().flat_map(of_heads));
        numbers.into_iter().all(|n| (0.0..=MOST).contains(&n))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn key() -> CalibrationKey {
        CalibrationKey {
            isa: "scalar".into(),
            model: "ab12".into(),
        }
    }

    fn calibration() -> Calibration {
        Calibration {
            machine: Machine::this(),
            isa: "scalar".into(),
            threads: rayon::current_num_threads(),
            model: "ab12".into(),
            spread: 1.1,
            exact: Curve(vec![[10.0, 1.5]]),
            heads: vec![HeadsCost {
                heads: HeadSet::Surfels,
                wide: true,
                per_voxel: 4.0,
                generate: Curve(vec![[10.0, 2.0]]),
                picture: PictureCost::default(),
            }],
        }
    }

    #[test]
    fn what_was_kept_is_found_again() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("b2p").join("c.json");
        let kept = calibration();
        kept.save(&path).unwrap();
        assert_eq!(Calibration::load(&path, &key()), Some(kept));
    }

    #[test]
    fn one_that_is_young_is_not_measured_again() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("c.json");
        calibration().save(&path).unwrap();
        assert!(!Calibration::may_be_retaken(&path));
        let file = std::fs::File::options().append(true).open(&path).unwrap();
        let old = std::time::SystemTime::now() - 2 * LEAST_AGE;
        file.set_modified(old).unwrap();
        assert!(Calibration::may_be_retaken(&path));
        // The clock has run backwards since.
        file.set_modified(std::time::SystemTime::now() + 2 * LEAST_AGE).unwrap();
        assert!(Calibration::may_be_retaken(&path));
    }

    #[test]
    fn what_is_of_another_machine_model_or_number_of_threads_is_not_taken() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("c.json");
        let spoil: [fn(&mut Calibration); 8] = [
            |c| c.machine.processor.push('x'),
            |c| c.machine.version.push('x'),
            |c| c.isa.push('x'),
            |c| c.model.push('x'),
            |c| c.threads += 1,
            |c| c.spread = -1.0,
            |c| c.exact.0[0][1] = -1.0,
            |c| c.heads[0].picture.per_pixel = -1.0,
        ];
        for (i, spoil) in spoil.iter().enumerate() {
            let mut kept = calibration();
            spoil(&mut kept);
            kept.save(&path).unwrap();
            assert_eq!(Calibration::load(&path, &key()), None, "{i}");
        }
    }

    #[test]
    fn whatever_lies_in_the_cache_is_no_calibration_and_no_harm() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("c.json");
        let load = |path: &Path| Calibration::load(path, &key());
        assert_eq!(load(&path), None, "nothing");
        assert_eq!(load(folder.path()), None, "a folder");
        let kept = serde_json::to_string(&calibration()).unwrap();
        let deep = "[".repeat(1 << 15);
        let endless = kept.replace("1.5", "1e999");
        let huge = " ".repeat(1 << 17) + &kept;
        let other = kept.replace("surfels", "s");
        let cut = &kept[..kept.len() / 2];
        for hostile in ["", "{}", "null", "\0\0", &deep, &endless, &huge, &other, cut] {
            std::fs::write(&path, hostile).unwrap();
            assert_eq!(load(&path), None, "{hostile:.40}");
        }
        #[cfg(unix)]
        {
            let link = folder.path().join("zero.json");
            std::os::unix::fs::symlink("/dev/zero", &link).unwrap();
            assert_eq!(load(&link), None, "a device");
        }
        let below_a_file = path.join("c.json");
        assert!(calibration().save(&below_a_file).is_err());
    }
}
