//! The suite of scenes, in `tests/data/conformance/scenes`.
//!
//! `suite.txt` has for each scene a line as in the suite of version 3, and one for each of its blocks: `name/block`;
//! `best.txt` and `quick.txt` have those of learned heads.

use b2p::{Decoder, Limits, SceneDecoder, SceneReader, Wanted};

use crate::digest_scene::{broken_clause, lines, parts};
use crate::heads::drawn;
use crate::{folder, pools, pools_for, stream};

fn text(file: &str) -> String {
    std::fs::read_to_string(folder().join("scenes").join(file)).expect("the suite is there")
}

/// Names of the scenes.
pub fn names() -> Vec<String> {
    let text = text("suite.txt");
    let first = text.lines().filter_map(|line| line.split(' ').next());
    let scenes = first.filter(|name| !name.contains('/'));
    scenes.map(|name| format!("scenes/{name}")).collect()
}

/// Whether some of a scene cannot be decoded.
pub fn is_refused(bytes: &[u8]) -> bool {
    let Ok(scene) = SceneReader::new(bytes, &Limits::unlimited()) else {
        return true;
    };
    let decoder = SceneDecoder::new(Decoder::new().with_limits(Limits::unlimited()));
    let decoded = decoder.voxels(&scene, &Wanted::All);
    scene.check_end().is_err() || decoded.map_or(true, |decoded| !decoded.lost.is_empty())
}

#[test]
fn every_scene_decodes_to_its_digests_whole_and_block_by_block() {
    let names = names();
    assert!(names.len() >= 6);
    let pools = pools();
    let ways = |isa| drawn(&folder(), isa).map(|(file, decoder)| (isa, file, decoder));
    for (isa, file, decoder) in super::instruction_sets().into_iter().flat_map(ways) {
        let text = text(file);
        for (threads, pool) in pools_for(file, &pools) {
            let decoded = |name: &String| {
                let found = parts(&decoder, &stream(name)).unwrap_or_else(|error| panic!("{name}: {error}"));
                lines(name.trim_start_matches("scenes/"), &found)
            };
            let decode = || names.iter().map(decoded).collect::<String>();
            let found = match pool {
                Some(pool) => pool.install(decode),
                None => decode(),
            };
            assert!(found == text, "{file} with {isa} and {threads} threads:\n{found}");
        }
    }
}

#[test]
fn the_suite_of_scenes_is_valid_and_has_blocks_of_many_sizes() {
    let mut levels = std::collections::BTreeSet::new();
    let mut blocks = Vec::new();
    for name in names() {
        let bytes = stream(&name);
        assert!(bytes.len() < 10_000, "{name} has {} bytes", bytes.len());
        assert_eq!(broken_clause(&bytes), None, "{name}");
        assert!(!is_refused(&bytes), "{name}");
        let scene = SceneReader::new(&bytes[..], &Limits::default()).expect("a scene");
        levels.extend(scene.blocks().iter().map(|block| block.cube.level));
        blocks.push(scene.blocks().len());
    }
    assert!(levels.len() >= 4, "levels {levels:?}");
    assert!(
        blocks.contains(&1) && blocks.iter().any(|count| *count > 12),
        "{blocks:?}"
    );
}

#[cfg(feature = "encoder")]
#[test]
fn the_generator_makes_the_same_scenes_again() {
    let cases = crate::make_scene::cases();
    assert_eq!(cases.len(), names().len());
    for (name, bytes, anywhere) in cases {
        assert!(
            !anywhere || bytes == stream(&format!("scenes/{name}")),
            "{name} has changed"
        );
    }
}
