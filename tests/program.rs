//! The program from outside: files in, files out, errors that say what is wrong, and nothing half-written.
#![cfg(feature = "cli")]

mod common;

use std::io::Write;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use common::{Ball, names_in};

fn b2p(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_b2p"))
        .current_dir(folder)
        .args(arguments)
        .output()
        .expect("the program starts")
}

/// The same with these bytes on standard input, in pieces.
fn piped(folder: &Path, arguments: &[&str], input: &[u8]) -> Output {
    let mut child = Command::new(env!("CARGO_BIN_EXE_b2p"))
        .current_dir(folder)
        .args(arguments)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the program starts");
    let mut pipe = child.stdin.take().expect("a pipe");
    for piece in input.chunks(1000) {
        // A program that has seen enough closes its end.
        let _ = pipe.write_all(piece).and_then(|()| pipe.flush());
    }
    drop(pipe);
    child.wait_with_output().expect("the program ends")
}

#[track_caller]
fn succeeds(folder: &Path, arguments: &[&str]) -> String {
    let output = b2p(folder, arguments);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{arguments:?} failed: {errors}");
    String::from_utf8(output.stdout).expect("output is UTF-8")
}

/// Runs a command that must fail, mention every one of `words`, and leave the folder as it was.
#[track_caller]
fn fails(folder: &Path, arguments: &[&str], words: &[&str]) {
    let before = names_in(folder);
    let output = b2p(folder, arguments);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{arguments:?}: {errors}");
    for word in words {
        assert!(
            errors.contains(word),
            "{arguments:?} should mention '{word}': {errors}"
        );
    }
    assert_eq!(
        names_in(folder),
        before,
        "{arguments:?} left something behind"
    );
}

/// A folder with `ball.ply`, a small coloured ball at 7 bits.
fn folder_with_cloud() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("ball.ply"), Ball::new(7, 40.0).to_ply()).unwrap();
    folder
}

/// The same with `ball.b2p`, coded with the program's own model.
fn folder_with_stream() -> tempfile::TempDir {
    let folder = folder_with_cloud();
    succeeds(
        folder.path(),
        &["encode", "ball.ply", "-o", "ball.b2p", "--bits", "7"],
    );
    folder
}

#[test]
fn a_cloud_becomes_a_stream_gaussians_and_pictures() {
    let folder = folder_with_stream();
    let at = folder.path();
    let info: serde_json::Value =
        serde_json::from_str(&succeeds(at, &["info", "ball.b2p", "--json"]))
            .expect("info prints JSON");
    assert_eq!(info["bits"], 7);
    assert_eq!(info["points"], Ball::new(7, 40.0).voxels().len());
    let levels: Vec<i64> = info["levels"]
        .as_array()
        .expect("levels is a list")
        .iter()
        .map(|l| l["level"].as_i64().expect("a number"))
        .collect();
    assert_eq!(levels, [4, 5, 6]);
    let size = std::fs::metadata(at.join("ball.b2p")).unwrap().len();
    assert_eq!(info["total_bytes"], size);

    for level in ["5", "6"] {
        succeeds(
            at,
            &["decode", "ball.b2p", "-o", "ball-g.ply", "--level", level],
        );
        let from_stream = [
            "render", "ball.b2p", "-o", "a.png", "--size", "96x64", "--level", level,
        ];
        succeeds(at, &from_stream);
        succeeds(
            at,
            &["render", "ball-g.ply", "-o", "b.png", "--size", "96x64"],
        );
        let (a, b) = (
            common::png(&at.join("a.png")),
            common::png(&at.join("b.png")),
        );
        assert_eq!((a.width(), a.height()), (96, 64));
        let worst = a
            .data()
            .iter()
            .zip(b.data())
            .map(|(a, b)| a.abs_diff(*b))
            .max();
        assert!(
            worst <= Some(2),
            "level {level}: stream and exported Gaussians differ by {worst:?}"
        );
    }
}

#[test]
fn several_views_are_numbered_and_differ() {
    let folder = folder_with_stream();
    let at = folder.path();
    succeeds(
        at,
        &[
            "render", "ball.b2p", "-o", "turn.png", "--views", "3", "--size", "48x48",
        ],
    );
    let pictures: Vec<_> = (0..3)
        .map(|i| common::png(&at.join(format!("turn-{i:03}.png"))))
        .collect();
    assert!(pictures[0].data() != pictures[1].data());
    assert!(!at.join("turn.png").exists());
}

#[test]
fn pictures_and_videos_go_to_a_pipe() {
    let folder = folder_with_stream();
    let at = folder.path();
    let piped = |args: &[&str]| {
        let fixed = ["render", "ball.b2p", "-o", "-", "--size", "32x24"];
        let done = b2p(at, &[&fixed[..], args].concat());
        assert!(done.status.success());
        done.stdout
    };
    assert!(piped(&[]).starts_with(b"\x89PNG"));
    assert!(piped(&["--format", "png16"]).starts_with(b"\x89PNG"));
    assert_eq!(piped(&["--format", "ppm"]).len(), 13 + 32 * 24 * 3);
    let exr = piped(&["--format", "exr"]);
    // Five channels, and for every line its place, its row and its length.
    assert!(exr.starts_with(b"\x76\x2f\x31\x01") && exr.len() > 24 * (16 + 32 * 5 * 4));
    let video = piped(&["--views", "4"]);
    assert!(video.starts_with(b"YUV4MPEG2 W32 H24 "));
    let header = video.iter().position(|&b| b == b'\n').unwrap() + 1;
    assert_eq!(video.len(), header + 4 * (6 + 32 * 24 * 3));
}

#[test]
fn the_numbers_of_a_picture_are_printed_as_json() {
    let folder = folder_with_stream();
    let at = folder.path();
    let args = ["render", "ball.b2p", "-o", "a.png", "--size", "64x64"];
    let done = b2p(at, &[&args[..], &["--stats", "json"]].concat());
    let json: serde_json::Value = serde_json::from_slice(&done.stdout).unwrap();
    assert!(json[0]["visible"].as_u64().unwrap() > 0);
    assert_eq!(json[0]["dropped"]["not_finite"], 0);
    let coverage = json[0]["coverage"].as_f64().unwrap();
    assert!((0.05..1.0).contains(&coverage), "{coverage}");
    assert!(json[0]["ms"]["total"].as_f64().unwrap() > 0.0);
}

#[test]
fn effects_are_explained_and_forced() {
    let folder = folder_with_stream();
    let at = folder.path();
    let draw = |name: &str, more: &[&str]| {
        let args = ["render", "ball.b2p", "-o", name, "--size", "16x16", "-v"];
        let done = b2p(at, &[&args[..], more].concat());
        assert!(done.status.success());
        String::from_utf8(done.stdout).unwrap()
    };
    assert!(draw("a.png", &[]).contains("antialias off: "));
    assert!(draw("b.png", &["--effect", "antialias=on"]).contains("antialias on: forced"));
    let [a, b] = ["a.png", "b.png"].map(|name| common::png(&at.join(name)));
    assert!(a.data() != b.data());
    for show in ["depth", "normal", "alpha", "id"] {
        draw("c.png", &["--show", show, "--orthographic"]);
    }
    let cost = draw("d.png", &["--effect", "order=on", "--quality", "exact"]);
    let line = cost.lines().find(|line| line.starts_with("order on"));
    assert!(line.is_some_and(|line| line.contains(" ms of ")), "{cost}");
}

#[test]
fn a_small_picture_is_drawn_from_a_coarser_level_unless_one_is_named() {
    let folder = folder_with_stream();
    let draw = |more: &[&str]| {
        let args = ["render", "ball.b2p", "-o", "a.png", "-v"];
        succeeds(folder.path(), &[&args[..], more].concat())
    };
    assert!(draw(&["--size", "8x8"]).contains("detail on: level 5"));
    assert!(draw(&["--size", "400x400"]).contains("detail off: level 6"));
    assert!(draw(&["--size", "8x8", "--level", "6"]).contains("detail off: level 6, forced"));
}

#[test]
fn drawing_is_timed_stage_by_stage() {
    let folder = folder_with_stream();
    let args = [
        "bench", "ball.b2p", "--render", "--size", "64x48", "--repeat", "2",
    ];
    assert!(succeeds(folder.path(), &args).contains("blend"));
    let json = succeeds(folder.path(), &[&args[..], &["--json"]].concat());
    let json: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!(
        (json["width"].as_u64(), json["runs"].as_u64()),
        (Some(64), Some(2))
    );
    let frame = json["median_ms"]["frame"].as_f64().unwrap();
    assert!(frame >= json["median_ms"]["project"].as_f64().unwrap());
}

#[test]
fn cameras_come_from_a_file_and_a_broken_one_is_named() {
    let folder = folder_with_stream();
    let at = folder.path();
    let shot = |scale: f64| {
        format!(
            r#"{{"file_path": "x", "transform_matrix":
             [[{scale}, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}}"#
        )
    };
    let file = |shots: &[String]| {
        let text = format!(
            r#"{{"camera_angle_x": 0.8, "frames": [{}]}}"#,
            shots.join(",")
        );
        std::fs::write(at.join("transforms.json"), text).unwrap();
    };
    let args = [
        "render",
        "ball.b2p",
        "-o",
        "f.png",
        "--size",
        "16x12",
        "--camera",
        "transforms.json",
    ];
    file(&[shot(1.0), shot(1.0)]);
    succeeds(at, &args);
    assert_eq!(common::png(&at.join("f-001.png")).width(), 16);
    file(&[shot(1.5)]);
    let done = b2p(at, &args);
    assert_eq!(done.status.code(), Some(1));
    let error = String::from_utf8(done.stderr).unwrap();
    assert!(
        error.contains("transforms.json") && error.contains("scales"),
        "{error}"
    );
}

#[test]
fn a_transparent_background_stays_transparent_in_the_corners() {
    let folder = folder_with_stream();
    let at = folder.path();
    succeeds(
        at,
        &[
            "render",
            "ball.b2p",
            "-o",
            "t.png",
            "--size",
            "64x64",
            "--background",
            "transparent",
        ],
    );
    let picture = common::png(&at.join("t.png"));
    assert_eq!(picture.pixel(0, 0).map(|p| p.alpha()), Some(0));
    assert_eq!(picture.pixel(32, 32).map(|p| p.alpha()), Some(255));
}

#[test]
fn a_level_without_gaussians_is_refused_and_the_others_are_named() {
    let folder = folder_with_stream();
    fails(
        folder.path(),
        &["decode", "ball.b2p", "-o", "x.ply", "--level", "4"],
        &["level 4", "5", "6"],
    );
    fails(
        folder.path(),
        &["decode", "ball.b2p", "-o", "x.ply", "--level", "9"],
        &["level 9"],
    );
}

#[test]
fn what_is_not_a_point_cloud_is_refused() {
    let folder = folder_with_cloud();
    let at = folder.path();
    std::fs::write(at.join("noise.ply"), b"this is no point cloud").unwrap();
    fails(
        at,
        &["encode", "noise.ply", "-o", "x.b2p"],
        &["noise.ply", "ply"],
    );
    fails(
        at,
        &["encode", "absent.ply", "-o", "x.b2p"],
        &["absent.ply"],
    );

    let header = |properties: &str, count: usize| {
        format!("ply\nformat ascii 1.0\nelement vertex {count}\n{properties}end_header\n")
    };
    let xyz = "property float x\nproperty float y\nproperty float z\n";
    let rgb = "property uchar red\nproperty uchar green\nproperty uchar blue\n";
    std::fs::write(at.join("grey.ply"), header(xyz, 1) + "1 2 3\n").unwrap();
    fails(
        at,
        &["encode", "grey.ply", "-o", "x.b2p"],
        &["grey.ply", "red"],
    );
    let coloured = header(&format!("{xyz}{rgb}"), 2);
    std::fs::write(
        at.join("nan.ply"),
        format!("{coloured}1 2 3 4 5 6\n1 nan 3 4 5 6\n"),
    )
    .unwrap();
    fails(
        at,
        &["encode", "nan.ply", "-o", "x.b2p"],
        &["nan.ply", "y", "line 12"],
    );
    std::fs::write(at.join("short.ply"), format!("{coloured}1 2 3 4 5 6\n")).unwrap();
    fails(at, &["encode", "short.ply", "-o", "x.b2p"], &["short.ply"]);
}

#[test]
fn a_damaged_stream_is_refused_and_nothing_is_written() {
    let folder = folder_with_stream();
    let at = folder.path();
    let stream = std::fs::read(at.join("ball.b2p")).unwrap();

    fails(
        at,
        &["decode", "ball.ply", "-o", "x.ply"],
        &["ball.ply", "b2p"],
    );
    std::fs::write(at.join("cut.b2p"), &stream[..stream.len() - 1]).unwrap();
    fails(
        at,
        &["decode", "cut.b2p", "-o", "x.ply", "--level", "6"],
        &["cut.b2p", "truncated"],
    );
    let mut flipped = stream.clone();
    let middle = flipped.len() / 2;
    flipped[middle] ^= 0x10;
    std::fs::write(at.join("flipped.b2p"), &flipped).unwrap();
    fails(
        at,
        &["render", "flipped.b2p", "-o", "x.png"],
        &["flipped.b2p", "checksum"],
    );
}

#[test]
fn another_model_is_recognised_before_anything_is_decoded() {
    let folder = folder_with_stream();
    let at = folder.path();
    std::fs::write(at.join("other.safetensors"), common::tiny_model(1)).unwrap();
    let arguments = [
        "decode",
        "ball.b2p",
        "-o",
        "x.ply",
        "--model",
        "other.safetensors",
    ];
    fails(at, &arguments, &["model"]);
    let no_model = ["decode", "ball.b2p", "-o", "x.ply", "--model", "ball.ply"];
    fails(at, &no_model, &["ball.ply"]);
}

#[test]
fn an_output_folder_that_does_not_exist_is_named() {
    let folder = folder_with_stream();
    fails(
        folder.path(),
        &["decode", "ball.b2p", "-o", "nowhere/x.ply"],
        &["nowhere"],
    );
}

#[test]
fn a_pipe_is_decoded_and_drawn_like_a_file() {
    let folder = folder_with_stream();
    let at = folder.path();
    let stream = std::fs::read(at.join("ball.b2p")).unwrap();
    let size = ["--size", "48x32"];
    succeeds(
        at,
        &[&["render", "ball.b2p", "-o", "file.png"], &size[..]].concat(),
    );
    let done = piped(
        at,
        &[&["render", "-", "-o", "pipe.png"], &size[..]].concat(),
        &stream,
    );
    assert!(done.status.success());
    let [file, pipe] = ["file.png", "pipe.png"].map(|name| std::fs::read(at.join(name)).unwrap());
    assert!(file == pipe);
    let done = piped(
        at,
        &[&["render", "-", "-o", "-"], &size[..]].concat(),
        &stream,
    );
    assert!(
        done.stdout == file,
        "one picture on standard output, the finest"
    );

    succeeds(at, &["decode", "ball.b2p", "-o", "file.ply"]);
    assert!(
        piped(at, &["decode", "-", "-o", "pipe.ply"], &stream)
            .status
            .success()
    );
    let [file, pipe] = ["file.ply", "pipe.ply"].map(|name| std::fs::read(at.join(name)).unwrap());
    assert!(file == pipe);
    let done = piped(
        at,
        &[&["render", "-", "-o", "g.png"], &size[..]].concat(),
        &file,
    );
    assert!(done.status.success(), "Gaussians come through a pipe too");
}

#[test]
fn a_pipe_that_breaks_off_leaves_the_finest_whole_level() {
    let folder = folder_with_stream();
    let at = folder.path();
    let stream = std::fs::read(at.join("ball.b2p")).unwrap();
    let cut = &stream[..stream.len() - 1];
    let done = piped(at, &["decode", "-", "-o", "cut.ply"], cut);
    let told = String::from_utf8_lossy(&done.stderr).into_owned();
    assert!(done.status.success(), "{told}");
    assert!(
        told.contains("truncated") && told.contains("level 5"),
        "{told}"
    );
    succeeds(
        at,
        &["decode", "ball.b2p", "-o", "five.ply", "--level", "5"],
    );
    let [cut_ply, five] = ["cut.ply", "five.ply"].map(|name| std::fs::read(at.join(name)).unwrap());
    assert!(cut_ply == five);

    let named = piped(at, &["decode", "-", "-o", "x.ply", "--level", "6"], cut);
    assert_eq!(
        named.status.code(),
        Some(1),
        "the level asked for is not there"
    );
    let nothing = piped(at, &["decode", "-", "-o", "x.ply"], &stream[..100]);
    assert_eq!(nothing.status.code(), Some(1));
    let mut damaged = stream.clone();
    damaged[stream.len() - 1] ^= 1;
    let damaged = piped(
        at,
        &["decode", "-", "-o", "y.ply", "--level", "6"],
        &damaged,
    );
    assert!(String::from_utf8_lossy(&damaged.stderr).contains("checksum"));
    assert!(!at.join("x.ply").exists() && !at.join("y.ply").exists());
}

#[test]
fn limits_can_be_set_and_say_how_to_raise_them() {
    let folder = folder_with_stream();
    let at = folder.path();
    let decode = ["decode", "ball.b2p", "-o", "x.ply"];
    for limit in [["--max-memory", "1M"], ["--max-points", "10"]] {
        fails(
            at,
            &[&decode[..], &limit].concat(),
            &["ball.b2p", "limit of", limit[0]],
        );
    }
    let render = ["render", "ball.b2p", "-o", "x.png"];
    let few = ["--max-pixels", "1000"];
    fails(
        at,
        &[&render[..], &few].concat(),
        &["1048576", "--max-pixels"],
    );
    let roomy = ["--limits", "embedded", "--max-memory", "1G"];
    succeeds(at, &[&decode[..], &roomy].concat());
}
