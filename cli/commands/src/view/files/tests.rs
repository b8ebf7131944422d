//! What arrives in the viewer of files.

use std::sync::mpsc::Receiver;

use super::*;

fn files() -> (Files, Receiver<(u64, Arrived)>) {
    let (sender, heard) = channel();
    let sender = std::sync::Mutex::new(sender);
    let loading = Loading {
        model: ModelArg {
            model: None,
            isa: None,
            precision: None,
        },
        per_voxel: None,
        up: None,
        limits: Limits::default(),
    };
    let tell = move |number, arrived| {
        let _ = sender.lock().unwrap().send((number, arrived));
    };
    (Files::start(loading, Arc::new(tell)).unwrap(), heard)
}

fn wish(number: u64, path: &Path, level: Option<u8>, heads: HeadSet) -> Wish {
    Wish {
        number,
        path: path.to_owned(),
        level,
        heads: Some(heads),
        camera: None,
    }
}

/// The levels and heads that arrive for a wish, and how it ends.
fn arrivals(heard: &Receiver<(u64, Arrived)>, number: u64) -> (Vec<(u8, HeadSet)>, std::result::Result<(), String>) {
    let mut made = Vec::new();
    for (of, arrived) in heard {
        assert_eq!(of, number);
        match arrived {
            Arrived::Choices(_) | Arrived::Skipped(_) => {}
            Arrived::Scene(scene) => made.extend(scene.made),
            Arrived::Done => return (made, Ok(())),
            Arrived::Failed(message) => return (made, Err(message)),
        }
    }
    panic!("the source has ended");
}

#[test]
fn a_stream_arrives_level_by_level_and_then_as_it_is_wanted() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.b2p");
    std::fs::write(&path, b2p::embedded::SCENE).unwrap();
    let levels = Decoder::new().levels(b2p::embedded::SCENE).unwrap();
    let (mut files, heard) = files();
    let surfels = HeadSet::Surfels;
    let all: Vec<_> = levels.iter().map(|level| (*level, surfels)).collect();
    files.want(wish(1, &path, None, surfels));
    assert_eq!(arrivals(&heard, 1), (all.clone(), Ok(())));
    files.want(wish(2, &path, None, HeadSet::Quick));
    assert_eq!(arrivals(&heard, 2).0, [(*levels.last().unwrap(), HeadSet::Quick)]);
    files.want(wish(3, &path, Some(levels[0]), surfels));
    assert_eq!(arrivals(&heard, 3).0, [all[0]]);
    files.want(wish(4, &path, Some(20), surfels));
    let (made, ended) = arrivals(&heard, 4);
    assert!(made.is_empty() && ended.unwrap_err().contains("level 20"));
    files.want(wish(5, &folder.path().join("missing"), None, surfels));
    assert!(arrivals(&heard, 5).1.unwrap_err().contains("missing"));
}

#[test]
fn a_stream_that_ends_early_arrives_as_far_as_it_is_whole() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cut.b2p");
    let whole = b2p::embedded::SCENE;
    std::fs::write(&path, &whole[..whole.len() * 2 / 3]).unwrap();
    let (mut files, heard) = files();
    files.want(wish(7, &path, None, HeadSet::Surfels));
    let (made, ended) = arrivals(&heard, 7);
    let levels = Decoder::new().levels(whole).unwrap();
    assert_eq!(ended, Ok(()));
    assert!(!made.is_empty() && made.len() < levels.len(), "{made:?}");
}
