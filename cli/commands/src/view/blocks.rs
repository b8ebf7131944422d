//! Scenes of blocks: shown as a whole if they fit into memory, else as far as a camera sees them.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use b2p::scene::{DecodedScene, ViewOptions};
use b2p::{Cancel, Decoder, Error, Extent, Gaussians, HeadSet, Log, SceneDecoder, Wanted};

use super::files::Loading;
use super::source::{Choices, Scene, Wish};
use crate::cloud::UpArg;
use crate::scene::{self, Reader};
use crate::{Failure, Result, cloud, load, manners};

/// Widths in pixels that voxels may have in a part of a scene, until it fits into memory.
const VOXEL_PIXELS: [f64; 5] = [1.0, 2.0, 4.0, 8.0, 16.0];

/// A scene whose index has been read.
pub struct OpenScene {
    path: PathBuf,
    scene: Reader,
    decoder: Decoder,
    levels: Vec<u8>,
    extent: Extent,
    up: Option<UpArg>,
    /// Blocks that have been complained of.
    lost: Vec<String>,
}

impl OpenScene {
    /// Reads the index, and decodes the coarsest level to know where the scene lies.
    pub fn open(path: &Path, loading: &Loading, cancel: &Cancel) -> Result<OpenScene> {
        let scene = scene::open(path, &loading.limits)?;
        let decoder = load::decoder(&[], &loading.detail(), &loading.model, &loading.limits)?;
        let decoder = decoder.with_cancel(cancel.clone());
        let fail = Failure::in_file(path);
        let all = SceneDecoder::new(decoder.clone());
        let levels = all.levels(&scene).map_err(&fail)?;
        Ok(OpenScene {
            extent: all.extent(&scene).map_err(&fail)?,
            path: path.to_owned(),
            scene,
            decoder,
            levels,
            up: loading.up,
            lost: Vec::new(),
        })
    }

    /// What there is to choose from.
    pub fn choices(&self) -> Choices {
        Choices {
            levels: self.levels.clone(),
            heads: HeadSet::ALL.to_vec(),
            timeline: None,
        }
    }

    /// The coarsest level, if it is not the one that is wanted: there at once.
    pub fn first(&mut self, wanted: &Wish) -> Option<Scene> {
        let coarsest = *self.levels.first()?;
        if self.goal(wanted) == Some(coarsest) {
            return None;
        }
        let (made, log) = self.whole(wanted, coarsest);
        Some(self.shown(made.ok()?, wanted, coarsest, false, &log))
    }

    /// What is wanted: the whole, or if that takes too much memory, what the camera sees of it, or without a camera, or if
    /// that takes too much as well, the finest level that fits.
    pub fn wanted(&mut self, wanted: &Wish) -> Result<Scene> {
        let path = self.path.clone();
        let fail = Failure::in_file(&path);
        let Some(goal) = self.goal(wanted) else {
            let what = "no level of the scene can be drawn";
            return Err(Failure(format!("{}: {what}", self.path.display())));
        };
        let (made, log) = self.whole(wanted, goal);
        let mut refused = match made {
            Ok(made) => return Ok(self.shown(made, wanted, goal, false, &log)),
            Err(error @ Error::LimitExceeded { .. }) => error,
            Err(error) => return Err(fail(error)),
        };
        let coarser = self.levels.iter().rev().copied().filter(|level| *level < goal);
        let coarser: Vec<u8> = coarser.collect();
        let seen = VOXEL_PIXELS.iter().filter(|_| wanted.camera.is_some());
        let seen = seen.map(|pixels| (goal, Some(*pixels)));
        for (level, pixels) in seen.chain(coarser.into_iter().map(|level| (level, None))) {
            let (made, log) = match pixels {
                Some(pixels) => self.seen(wanted, level, pixels),
                None => self.whole(wanted, level),
            };
            match made {
                Ok(made) => return Ok(self.shown(made, wanted, level, true, &log)),
                Err(error @ Error::LimitExceeded { .. }) => refused = error,
                Err(error) => return Err(fail(error)),
            }
        }
        Err(fail(refused))
    }

    fn goal(&self, wanted: &Wish) -> Option<u8> {
        wanted.level.or(self.levels.last().copied())
    }

    /// Decodes to a level, with the heads that are wanted.
    fn drawing(&self, wanted: &Wish, level: u8) -> SceneDecoder {
        let mut decoder = self.decoder.clone().with_level(level);
        if let Some(heads) = wanted.heads {
            decoder = decoder.with_heads(heads);
        }
        SceneDecoder::new(decoder)
    }

    fn whole(&self, wanted: &Wish, level: u8) -> (b2p::Result<DecodedScene<Gaussians>>, Log) {
        let log = Log::new();
        let decoder = self.drawing(wanted, level);
        let blocks = self.scene.blocks().len();
        let made = log.step("decode scene", blocks, "blocks", || {
            decoder.gaussians(&self.scene, &Wanted::All)
        });
        (made, log)
    }

    fn seen(&self, wanted: &Wish, level: u8, pixels: f64) -> (b2p::Result<DecodedScene<Gaussians>>, Log) {
        let log = Log::new();
        let decoder = self.drawing(wanted, level);
        let blocks = self.scene.blocks().len();
        let options = ViewOptions::default().with_voxel_pixels(pixels);
        let made = log.step("decode what is seen", blocks, "blocks", || match &wanted.camera {
            Some(camera) => decoder.visible(&self.scene, camera, options),
            None => decoder.gaussians(&self.scene, &Wanted::All),
        });
        (made, log)
    }

    /// Makes a scene to be shown of what was decoded.
    fn shown(&mut self, made: DecodedScene<Gaussians>, wanted: &Wish, level: u8, is_part: bool, log: &Log) -> Scene {
        for error in made.lost {
            let what = error.to_string();
            if !self.lost.contains(&what) {
                manners::warn(&format!("{}: {what}", self.path.display()));
                self.lost.push(what);
            }
        }
        let heads = wanted
            .heads
            .unwrap_or_else(|| self.decoder.heads_for(self.scene.header()));
        Scene {
            extent: self.extent.clone(),
            gaussians: Arc::new(made.content),
            up: cloud::up_of(self.up, &self.scene.axes().unwrap_or_default()),
            made: Some((level, heads)),
            is_part,
            steps: log.steps(),
            frame: None,
        }
    }
}

#[cfg(test)]
mod tests {
    use b2p::cloud::ColouredVoxels;
    use b2p::geometry::{Voxels, morton};
    use b2p::{Camera, Limits, Placement, SceneEncoder};

    use super::*;
    use crate::args::ModelArg;

    /// A folder with `scene.b2p`: two slanted walls in some blocks, levels 4 to 6.
    fn folder() -> tempfile::TempDir {
        let cells = (0..64 * 64u32).flat_map(|i| [[i % 64, i / 64, i % 64 / 4], [i % 64, i / 64, 60]]);
        let voxels = Voxels::new(6, cells.map(morton::encode).collect());
        let cloud = ColouredVoxels {
            colours: voxels.keys().iter().map(|key| [*key as u8, 90, 200]).collect(),
            voxels,
            placement: Placement::VOXEL_GRID,
        };
        let encoder = SceneEncoder::new().with_levels(4..=6).with_block_voxels(900);
        let folder = tempfile::tempdir().unwrap();
        let bytes = encoder.encode(&cloud).expect("a small cloud is coded");
        std::fs::write(folder.path().join("scene.b2p"), bytes).unwrap();
        folder
    }

    fn open(folder: &tempfile::TempDir, max_bytes: u64) -> Result<OpenScene> {
        let loading = Loading {
            model: ModelArg {
                model: None,
                isa: None,
                precision: None,
            },
            per_voxel: None,
            up: None,
            limits: Limits::default().with_max_bytes(max_bytes),
        };
        OpenScene::open(&folder.path().join("scene.b2p"), &loading, &Cancel::default())
    }

    fn wish(level: Option<u8>, camera: Option<Camera>) -> Wish {
        Wish {
            number: 1,
            path: PathBuf::new(),
            level,
            heads: Some(HeadSet::Surfels),
            camera,
        }
    }

    #[test]
    fn a_scene_that_fits_into_memory_is_shown_whole_its_coarsest_level_first() {
        let folder = folder();
        let mut scene = open(&folder, u64::MAX).unwrap();
        assert_eq!(scene.choices().levels, [4, 5, 6]);
        let first = scene.first(&wish(None, None)).expect("something is there at once");
        assert_eq!(first.made, Some((4, HeadSet::Surfels)));
        let whole = scene.wanted(&wish(None, None)).unwrap();
        assert_eq!((whole.made, whole.is_part), (Some((6, HeadSet::Surfels)), false));
        assert!(whole.gaussians.len() > first.gaussians.len());
        assert_eq!(whole.extent, first.extent);
        assert!(scene.first(&wish(Some(4), None)).is_none(), "it is what is wanted");
    }

    #[test]
    fn a_scene_that_does_not_fit_is_shown_coarsely_and_then_as_far_as_a_camera_sees_it() {
        let folder = folder();
        let camera = Camera::orbit(0.0, 0.0, 1.2, 20.0, 64, 64).unwrap();
        let mut parts = 0;
        for max_bytes in (0..60).map(|step| (60_000.0 * 1.1f64.powi(step)) as u64) {
            let Ok(mut scene) = open(&folder, max_bytes) else {
                continue;
            };
            let Ok(coarse) = scene.wanted(&wish(None, None)) else {
                continue;
            };
            if !coarse.is_part {
                continue;
            }
            assert!(coarse.made.is_some_and(|(level, _)| level < 6), "{:?}", coarse.made);
            let seen = scene.wanted(&wish(None, Some(camera))).unwrap();
            assert!(seen.is_part && !seen.gaussians.is_empty());
            assert_eq!(seen.extent, coarse.extent);
            // Near the least limit a part does not fit either.
            let finest = seen.made == Some((6, HeadSet::Surfels));
            assert!(finest || seen.made == coarse.made, "{:?}", seen.made);
            parts += usize::from(finest);
        }
        assert!(parts > 0, "no limit was between a coarse level and the finest");
        let mut scene = open(&folder, 1 << 24).unwrap();
        assert!(
            !scene.wanted(&wish(None, Some(camera))).unwrap().is_part,
            "all of it fits"
        );
    }

    #[test]
    fn a_scene_of_which_nothing_fits_is_an_error_that_names_the_limit() {
        let folder = folder();
        let found = open(&folder, 20_000).and_then(|mut scene| scene.wanted(&wish(None, None)));
        let Err(Failure(error)) = found else { panic!("it fits") };
        assert!(
            error.contains("scene.b2p") && error.contains("20000") | error.contains("20,000"),
            "{error}"
        );
    }
}
