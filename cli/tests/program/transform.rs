//! What is of streams of version 3 alone.

use b2p::cloud::{PointCloud, voxelise};

use super::*;

fn info(at: &Path, stream: &str) -> Value {
    let info = succeeds(at, &["info", stream, "--json"]);
    serde_json::from_str(&info).expect("info prints JSON")
}

#[test]
fn steps_and_exact_colours_are_coded_as_asked_for_and_told_by_info() {
    let folder = folder_with_cloud();
    let at = folder.path();
    let coded = |how: &[&str]| {
        succeeds(at, &[&["encode", "ball.ply", "-o", "x.b2p"], how].concat());
        info(at, "x.b2p")
    };
    let (coarse, fine) = (coded(&["--step", "64"]), coded(&["--step", "2"]));
    assert_eq!(fine["version"], 3);
    assert!(fine["model"].is_null());
    assert_eq!(fine["levels"][2]["luma_step"], 2.0);
    assert_eq!(coarse["levels"][2]["luma_step"], 64.0);
    assert!(coarse["total_bytes"].as_u64() < fine["total_bytes"].as_u64());
    let exact = coded(&["--lossless", "--levels", "5..7"]);
    assert_eq!(exact["levels"][2]["lossless"], true);

    succeeds(at, &["decode", "x.b2p", "--points", "-o", "points.ply"]);
    let read = |name: &str| {
        let cloud = PointCloud::open(at.join(name), &b2p::Limits::default());
        voxelise(&cloud.expect("a cloud"), Some(7)).expect("a grid")
    };
    assert_eq!(read("points.ply"), read("ball.ply"), "all points, exactly");
}

#[test]
fn bits_per_point_are_kept_to_and_what_is_said_makes_the_same_stream() {
    let folder = folder_with_cloud();
    let at = folder.path();
    let points = Ball::new(7, 40.0).voxels().len() as f64;
    let encode = ["encode", "ball.ply", "-o", "ball.b2p", "--bits-per-point"];
    let said = succeeds(at, &[&encode[..], &["1"]].concat());
    let bits = std::fs::metadata(at.join("ball.b2p")).unwrap().len() as f64 * 8.0 / points;
    assert!((0.7..=1.0).contains(&bits), "{said}");
    let chosen = said.rsplit("of at most 1: level ").next().unwrap();
    let (level, step) = chosen.trim().split_once(", step ").expect("a step is said");
    let levels = format!("4..{level}");
    let by_hand = ["--levels", &levels, "--step", step];
    succeeds(
        at,
        &[&["encode", "ball.ply", "-o", "by-hand.b2p"], &by_hand[..]].concat(),
    );
    let [found, by_hand] = ["ball.b2p", "by-hand.b2p"].map(|name| std::fs::read(at.join(name)).unwrap());
    assert!(found == by_hand, "what is said makes the same stream");
    let said = succeeds(at, &[&encode[..], &["1000"]].concat());
    assert!(said.contains("of at most 1000: level 7, exact colours"), "{said}");
}

#[test]
fn options_of_the_other_way_to_code_colours_are_refused() {
    let folder = folder_with_stream();
    let at = folder.path();
    let encode = ["encode", "ball.ply", "-o", "x.b2p"];
    let refused = |more: &[&str], words: &[&str]| {
        fails(at, &[&encode[..], more].concat(), words);
    };
    refused(&["--lambda-scale", "2"], &["--lambda-scale", "--colours learned"]);
    refused(&["--model", "m"], &["--model", "--colours learned"]);
    let learned = ["--colours", "learned", "--step", "8"];
    refused(&learned, &["--step", "--colours transform"]);
}

#[test]
fn a_learned_stream_has_no_points_and_no_surfels() {
    let folder = folder_with_learned_stream();
    let points = ["decode", "ball.b2p", "--points", "-o", "x.ply"];
    fails(folder.path(), &points, &["ball.b2p", "version 2"]);
    let surfels = ["decode", "ball.b2p", "--heads", "surfels", "-o", "x.ply"];
    fails(folder.path(), &surfels, &["ball.b2p", "surfels"]);
}

#[test]
fn stages_are_timed() {
    let folder = folder_with_stream();
    let bench = ["bench", "ball.b2p", "--repeat", "1", "--json"];
    let bench: Value = serde_json::from_str(&succeeds(folder.path(), &bench)).unwrap();
    let stages = bench["stages"].as_array().expect("a list");
    let names: Vec<_> = stages.iter().filter_map(|stage| stage["stage"].as_str()).collect();
    assert!(names.contains(&"colours of level 6"), "{names:?}");
    assert_eq!(bench["level"], 6);
}
