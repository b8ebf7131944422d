//! Scenes through the program: coded in blocks, from memory and from disk; described, checked, cut, decoded and drawn.

use std::path::Path;

use serde_json::Value;
use tempfile::TempDir;

use super::common::Ball;
use super::{b2p, fails, folder_with_cloud, piped, png, succeeds};

const CODING: [&str; 6] = ["--bits", "7", "--levels", "4..6", "--block-size", "2000"];

/// A folder with `ball.ply` and `ball.b2p`, a scene of its blocks.
fn folder() -> TempDir {
    let folder = folder_with_cloud();
    succeeds(
        folder.path(),
        &[&["encode", "ball.ply", "-o", "ball.b2p"][..], &CODING].concat(),
    );
    folder
}

fn bytes(at: &Path, name: &str) -> Vec<u8> {
    std::fs::read(at.join(name)).unwrap()
}

fn json(at: &Path, arguments: &[&str]) -> Value {
    serde_json::from_str(&succeeds(at, &[arguments, &["--json"]].concat())).unwrap()
}

#[test]
fn a_cloud_above_the_block_size_becomes_a_scene_unless_that_is_declined() {
    let folder = folder();
    let at = folder.path();
    let info = json(at, &["info", "ball.b2p"]);
    let blocks = info["blocks"].as_array().unwrap();
    assert!(blocks.len() >= 8, "{info}");
    assert!(succeeds(at, &["check", "ball.b2p"]).contains("valid"));
    assert!(succeeds(at, &["info", "ball.b2p"]).contains("scene of"));
    let again = ["encode", "ball.ply", "-o", "again.b2p", "--threads", "1"];
    succeeds(at, &[&again[..], &CODING].concat());
    assert!(bytes(at, "ball.b2p") == bytes(at, "again.b2p"));
    succeeds(
        at,
        &["encode", "ball.ply", "-o", "one.b2p", "--bits", "7", "--no-blocks"],
    );
    let info = json(at, &["info", "one.b2p"]);
    assert!(info["blocks"].is_null());
    fails(
        at,
        &["decode", "one.b2p", "-o", "box.ply", "--box", "0,0,0,9,9,9"],
        &["no scene"],
    );
}

#[test]
fn a_cloud_that_does_not_fit_into_memory_is_sorted_on_disk_to_the_same_scene() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    std::fs::write(at.join("text.ply"), Ball::new(7, 50.0).to_ply()).unwrap();
    for name in ["ball.ply", "ball.las"] {
        succeeds(at, &["convert", "text.ply", "-o", name, "--points"]);
        let coding = ["--bits", "7", "--levels", "4..6", "--block-size", "2000"];
        succeeds(at, &[&["encode", name, "-o", "memory.b2p"][..], &coding].concat());
        let little = ["encode", name, "-o", "disk.b2p", "--max-memory", "1M"];
        let output = b2p(at, &[&little[..], &coding].concat());
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let [memory, disk] = ["memory.b2p", "disk.b2p"].map(|scene| {
            succeeds(at, &["decode", scene, "-o", "points.ply", "--points"]);
            bytes(at, "points.ply")
        });
        assert!(memory == disk, "{name}");
    }
    let asked = [
        "encode",
        "ball.ply",
        "-o",
        "x.b2p",
        "--max-memory",
        "1M",
        "--bits",
        "7",
        "--drop-outliers",
    ];
    fails(at, &asked, &["--drop-outliers", "memory"]);
}

#[test]
fn parts_of_a_scene_are_decoded_cut_and_drawn() {
    let folder = folder();
    let at = folder.path();
    let surfels = ["--heads", "surfels"];
    let count = |arguments: &[&str]| json(at, &[arguments, &surfels].concat())["count"].as_u64().unwrap();
    let all = count(&["decode", "ball.b2p", "-o", "all.ply"]);
    let half = ["decode", "ball.b2p", "-o", "half.ply", "--box", "0,0,0,63,128,128"];
    let part = count(&half);
    assert!(part > all / 3 && part < 2 * all / 3, "{part} of {all}");
    succeeds(
        at,
        &[
            "decode",
            "ball.b2p",
            "-o",
            "points.ply",
            "--points",
            "--box",
            "0,0,0,63,128,128",
        ],
    );
    succeeds(at, &["cut", "ball.b2p", "-o", "cut.b2p", "--level", "5"]);
    let levels = json(at, &["info", "cut.b2p"])["levels"].clone();
    assert_eq!(levels, serde_json::json!([4, 5]));
    succeeds(at, &["decode", "cut.b2p", "-o", "cut.ply", "--points"]);
    succeeds(
        at,
        &["decode", "ball.b2p", "-o", "level.ply", "--points", "--level", "5"],
    );
    assert!(bytes(at, "cut.ply") == bytes(at, "level.ply"));
    // Drawn from what is seen, and from everything.
    let view = ["--orbit", "30,20,3", "--size", "96x96"];
    succeeds(
        at,
        &[&["render", "ball.b2p", "-o", "seen.png"][..], &view, &surfels].concat(),
    );
    succeeds(at, &[&["render", "all.ply", "-o", "all.png"][..], &view].concat());
    let [seen, all] = ["seen.png", "all.png"].map(|name| png(&at.join(name)));
    let off = seen.data().iter().zip(all.data()).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(off <= Some(1), "{off:?}");
    succeeds(
        at,
        &[
            "render", "ball.b2p", "-o", "many.png", "--views", "3", "--size", "64x64", "--lod", "1",
        ],
    );
    fails(
        at,
        &["decode", "ball.b2p", "-o", "x.ply", "--box", "900,0,0,901,1,1"],
        &["no voxel"],
    );
    fails(
        at,
        &["cut", "ball.b2p", "-o", "x.b2p", "--level", "9"],
        &["levels 4 to 6"],
    );
}

#[test]
fn memory_that_a_view_may_take_is_said_first_with_what_takes_less() {
    let folder = folder();
    let at = folder.path();
    let drawn = |more: &[&str]| {
        let picture = [
            "render", "ball.b2p", "-o", "a.png", "--size", "64x64", "--heads", "surfels", "--orbit", "20,20,3",
        ];
        let output = b2p(at, &[&picture[..], more].concat());
        String::from_utf8(output.stderr).unwrap()
    };
    let warned = drawn(&["--max-memory", "100K"]);
    assert!(
        warned.contains("may take ") && warned.contains("a greater --lod, 0 now"),
        "{warned}"
    );
    assert!(!drawn(&[]).contains("may take "));
}

#[test]
fn damage_stays_in_its_block_and_is_reported() {
    let folder = folder();
    let at = folder.path();
    let blocks = json(at, &["info", "ball.b2p"])["blocks"].clone();
    let third = &blocks[2];
    let mut damaged = bytes(at, "ball.b2p");
    damaged[third["offset"].as_u64().unwrap() as usize + 150] ^= 4;
    std::fs::write(at.join("damaged.b2p"), damaged).unwrap();
    for how in [&["--points"][..], &["--heads", "surfels"]] {
        let output = b2p(at, &[&["decode", "damaged.b2p", "-o", "rest.ply"][..], how].concat());
        let errors = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1));
        assert!(errors.contains("block 2") && errors.contains("1 block of"), "{errors}");
        let rest = bytes(at, "rest.ply");
        assert!(rest.len() > 1000, "the other blocks are written");
        std::fs::remove_file(at.join("rest.ply")).unwrap();
    }
    let output = b2p(at, &["check", "damaged.b2p"]);
    let said = String::from_utf8(output.stdout).unwrap();
    assert_eq!(output.status.code(), Some(1), "{said}");
    let start = third["offset"].as_u64().unwrap();
    let hash = format!("\n  clause 18.2.4, block 2, byte {start}: ");
    assert!(said.contains("not valid: ") && said.contains(&hash), "{said}");
    // And the chunk in it.
    let place = said
        .split("\n  clause 3.1.1, block 2, level ")
        .nth(1)
        .and_then(|rest| rest.split(", byte ").nth(1));
    let place = place.and_then(|rest| rest.split([':', ',']).next()?.parse::<u64>().ok());
    assert!(
        place.is_some_and(|place| place > start && place <= start + 150),
        "{said}"
    );
    let cut = &bytes(at, "ball.b2p")[..blocks[5]["offset"].as_u64().unwrap() as usize];
    std::fs::write(at.join("short.b2p"), cut).unwrap();
    let output = b2p(at, &["decode", "short.b2p", "-o", "rest.ply", "--points"]);
    assert_eq!(output.status.code(), Some(1));
    assert!(at.join("rest.ply").exists());
}

/// What a command makes of `ball.b2p` as a file and from standard input: both results.
#[track_caller]
fn both_ways(at: &Path, arguments: &[&str], output: &str) -> [Vec<u8>; 2] {
    let scene = bytes(at, "ball.b2p");
    let run = |input: &str| {
        let arguments: Vec<&str> = arguments
            .iter()
            .map(|word| if *word == "IN" { input } else { word })
            .collect();
        let run = piped(at, &arguments, &scene);
        let errors = String::from_utf8_lossy(&run.stderr);
        assert!(run.status.success(), "{arguments:?}: {errors}");
        match output {
            "" => run.stdout,
            name => bytes(at, name),
        }
    };
    ["ball.b2p", "-"].map(run)
}

#[test]
fn a_scene_on_standard_input_is_what_it_is_in_a_file() {
    let folder = folder();
    let at = folder.path();
    for (arguments, output) in [
        (&["decode", "IN", "-o", "out.ply", "--heads", "surfels"][..], "out.ply"),
        (
            &["decode", "IN", "-o", "out.ply", "--points", "--box", "0,0,0,63,128,128"],
            "out.ply",
        ),
        (&["decode", "IN", "-o", "-", "--points", "--level", "5"], ""),
        (
            &["render", "IN", "-o", "out.png", "--size", "64x64", "--heads", "surfels"],
            "out.png",
        ),
        (&["cut", "IN", "-o", "out.b2p", "--level", "5"], "out.b2p"),
        (&["info", "IN", "--json"], ""),
        (&["view", "IN", "--terminal", "--size", "20x20"], ""),
    ] {
        let [file, pipe] = both_ways(at, arguments, output);
        assert!(!file.is_empty() && file == pipe, "{arguments:?}");
    }
    let checked = piped(at, &["check", "-"], &bytes(at, "ball.b2p"));
    assert!(checked.status.success());
    assert!(String::from_utf8_lossy(&checked.stdout).contains("valid, "));
}

#[test]
fn a_scene_on_standard_input_is_held_to_the_limits_and_read_as_far_as_it_goes() {
    let folder = folder();
    let at = folder.path();
    let scene = bytes(at, "ball.b2p");
    let most = (scene.len() - 1).to_string();
    let limited = piped(at, &["decode", "-", "-o", "out.ply", "--max-memory", &most], &scene);
    let errors = String::from_utf8_lossy(&limited.stderr);
    assert!(
        limited.status.code() == Some(1) && errors.contains("--max-memory"),
        "{errors}"
    );
    let cut = piped(
        at,
        &["decode", "-", "-o", "out.ply", "--points"],
        &scene[..scene.len() - 9],
    );
    let errors = String::from_utf8_lossy(&cut.stderr);
    assert!(
        cut.status.code() == Some(1) && errors.contains("1 block of"),
        "{errors}"
    );
    assert!(at.join("out.ply").exists(), "the other blocks are written");
    for start in [0, 9, 15, 16, 40] {
        let cut = piped(at, &["decode", "-", "-o", "none.ply"], &scene[..start]);
        assert_eq!(cut.status.code(), Some(1), "{start} bytes");
    }
    assert!(!at.join("none.ply").exists());
}

#[test]
fn the_time_that_a_scene_takes_is_measured_as_that_of_a_stream() {
    let folder = folder();
    let timed = json(
        folder.path(),
        &["bench", "ball.b2p", "--repeat", "1", "--heads", "surfels"],
    );
    let stages = timed["stages"].as_array().unwrap();
    assert_eq!(stages.len(), 1, "{timed}");
    assert_eq!((&timed["level"], &timed["heads"]), (&6.into(), &"surfels".into()));
    assert!(stages[0]["stage"] == "decode scene" && stages[0]["count"].as_u64() >= Some(8));
    assert!(timed["decode_ms"].as_f64() > Some(0.0));
}

#[test]
fn a_scene_that_is_too_large_for_memory_is_viewed_as_far_as_the_camera_sees_it() {
    let folder = folder();
    let at = folder.path();
    // Near enough that a part of the ball is in view.
    let near = [
        "view",
        "ball.b2p",
        "--terminal",
        "--size",
        "40x20",
        "--orbit",
        "0,0,1",
        "--heads",
        "surfels",
    ];
    let whole = b2p(at, &near);
    assert!(whole.status.success());
    let mut parts = 0;
    for step in 0..40 {
        let most = (100_000.0 * 1.1f64.powi(step)) as u64;
        let limit = ["--max-memory", &most.to_string()[..]];
        let decode = ["decode", "ball.b2p", "-o", "out.ply", "--heads", "surfels"];
        let part = b2p(at, &[&near[..], &limit].concat());
        if b2p(at, &[&decode[..], &limit].concat()).status.success() || !part.status.success() {
            continue;
        }
        // Near the least limit less is shown, in as many lines.
        parts += usize::from(part.stdout.len() == whole.stdout.len());
        let lines = |stdout: &[u8]| stdout.iter().filter(|byte| **byte == b'\n').count();
        assert_eq!(lines(&part.stdout), lines(&whole.stdout), "at most {most} bytes");
    }
    assert!(parts > 0, "no limit was between a part and the whole");
}
