//! The program from outside: files in, files out, errors that say what is wrong, and nothing half-written.

mod checking;
mod clouds;
#[path = "../../../tests/common/mod.rs"]
mod common;
mod converting;
mod cutting;
mod data;
mod edges;
mod faults;
mod framing;
mod knobs;
mod many;
mod outputs;
mod pictures;
mod planning;
mod rate_control;
mod scenes;
#[path = "../../../tests/common/seal.rs"]
mod seal;
mod sequences;
mod serving;
mod transform;

use std::io::Write;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use b2p::latents::network::{Shape, untrained};
use common::{Ball, names_in, tiny_model};
use serde_json::Value;

/// Runs the program, which may overwrite files: most tests write the same file again and again.
fn b2p(folder: &Path, arguments: &[&str]) -> Output {
    plain(folder, &[arguments, &["--force"]].concat())
}

/// Runs the program with these arguments alone.
fn plain(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_b2p"))
        .current_dir(folder)
        .args(arguments)
        .stdin(Stdio::null())
        .output()
        .expect("the program starts")
}

/// The same with these bytes on standard input, in pieces.
fn piped(folder: &Path, arguments: &[&str], input: &[u8]) -> Output {
    let mut child = Command::new(env!("CARGO_BIN_EXE_b2p"))
        .current_dir(folder)
        .args(arguments)
        .arg("--force")
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

/// Runs a command that must succeed: its result, or its report if it has no result.
#[track_caller]
fn succeeds(folder: &Path, arguments: &[&str]) -> String {
    let output = b2p(folder, arguments);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{arguments:?} failed: {errors}");
    match output.stdout.is_empty() {
        true => errors.into_owned(),
        false => String::from_utf8(output.stdout).expect("output is UTF-8"),
    }
}

/// Runs a command that must fail, mention every one of `words`, and leave the folder as it was.
#[track_caller]
fn fails(folder: &Path, arguments: &[&str], words: &[&str]) {
    let before = names_in(folder);
    let output = b2p(folder, arguments);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{arguments:?}: {errors}");
    for word in words {
        assert!(errors.contains(word), "{arguments:?} should mention '{word}': {errors}");
    }
    assert_eq!(names_in(folder), before, "{arguments:?} left something behind");
}

/// A folder with `ball.ply`, a small coloured ball at 7 bits.
fn folder_with_cloud() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("ball.ply"), Ball::new(7, 40.0).to_ply()).unwrap();
    folder
}

/// The same with `ball.b2p`, a stream of version 3.
fn folder_with_stream() -> tempfile::TempDir {
    folder_coded("transform")
}

/// The same with a stream of version 2, coded with the program's own model.
fn folder_with_learned_stream() -> tempfile::TempDir {
    folder_coded("learned")
}

fn folder_coded(colours: &str) -> tempfile::TempDir {
    let folder = folder_with_cloud();
    let encode = ["encode", "ball.ply", "-o", "ball.b2p", "--bits", "7"];
    let how = ["--colours", colours];
    succeeds(folder.path(), &[&encode[..], &how].concat());
    folder
}

/// Reads a picture.
fn png(path: &Path) -> tiny_skia::Pixmap {
    tiny_skia::Pixmap::load_png(path).expect("a readable PNG")
}

/// So many points spread evenly over a ball, in metres.
fn sparse_ball(points: usize) -> String {
    use std::fmt::Write;
    let mut ply = format!(
        "ply\nformat ascii 1.0\nelement vertex {points}\nproperty float x\nproperty float y\nproperty float z\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
    );
    for i in 0..points {
        let (z, turn) = (2.0 * (i as f64 + 0.5) / points as f64 - 1.0, i as f64 * 2.399_963);
        let (x, y) = ((1.0 - z * z).sqrt() * turn.cos(), (1.0 - z * z).sqrt() * turn.sin());
        writeln!(ply, "{x} {y} {z} 200 80 {}", i % 256).expect("a String takes all");
    }
    ply
}

#[test]
fn a_sparse_cloud_gets_as_many_bits_as_close_its_surface_unless_told_otherwise() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    std::fs::write(at.join("sparse.ply"), sparse_ball(6000)).unwrap();
    let bits = |arguments: &[&str]| {
        let said = succeeds(at, &[&["encode", "sparse.ply", "-o", "s.b2p"], arguments].concat());
        let info = succeeds(at, &["info", "s.b2p", "--json"]);
        let info: serde_json::Value = serde_json::from_str(&info).expect("info prints JSON");
        (info["bits"].as_u64(), said.contains("--bits 10"))
    };
    assert_eq!(bits(&[]), (Some(5), true));
    assert_eq!(bits(&["--bits", "10"]), (Some(10), false));
}

#[test]
fn a_cloud_becomes_a_stream_gaussians_and_pictures() {
    for colours in ["transform", "learned"] {
        becomes_pictures(folder_coded(colours).path());
    }
}

#[track_caller]
fn becomes_pictures(at: &Path) {
    let info: serde_json::Value =
        serde_json::from_str(&succeeds(at, &["info", "ball.b2p", "--json"])).expect("info prints JSON");
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
        succeeds(at, &["decode", "ball.b2p", "-o", "ball-g.ply", "--level", level]);
        let from_stream = ["render", "ball.b2p", "-o", "a.png", "--size", "96x64", "--level", level];
        succeeds(at, &from_stream);
        succeeds(at, &["render", "ball-g.ply", "-o", "b.png", "--size", "96x64"]);
        let (a, b) = (png(&at.join("a.png")), png(&at.join("b.png")));
        assert_eq!((a.width(), a.height()), (96, 64));
        let worst = a.data().iter().zip(b.data()).map(|(a, b)| a.abs_diff(*b)).max();
        assert!(
            worst <= Some(2),
            "level {level}: stream and exported Gaussians differ by {worst:?}"
        );
    }
}

#[test]
fn a_residual_is_coded_as_finely_as_asked_for_and_told_by_info() {
    let folder = folder_with_cloud();
    let at = folder.path();
    let bytes = |residual: &[&str]| {
        let encode = ["encode", "ball.ply", "-o", "ball.b2p"];
        let learned = ["--colours", "learned"];
        succeeds(at, &[&encode, &learned[..], residual].concat());
        let info = succeeds(at, &["info", "ball.b2p", "--json"]);
        let info: Value = serde_json::from_str(&info).expect("info prints JSON");
        let of = |level: usize| info["levels"][level]["residual_bytes"].as_u64();
        assert_eq!((of(0), of(1)), (Some(0), Some(0)), "coarser levels have none");
        of(2).expect("the level is whole")
    };
    let none = bytes(&["--residual", "none"]);
    let [coarse, fine] = ["40", "5"].map(|step| bytes(&["--residual", step]));
    let colourful = bytes(&["--residual", "40,1"]);
    assert!(none == 0 && 0 < coarse && coarse < fine && coarse < colourful);
    for wrong in ["0", "256", "40,", "40,0", "a few"] {
        let encode = ["encode", "ball.ply", "-o", "x.b2p", "--residual", wrong];
        let output = b2p(at, &encode);
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success() && errors.contains("1 to 255"), "{errors}");
        assert!(!at.join("x.b2p").exists());
    }
}

#[test]
fn quick_heads_are_used_where_the_model_has_them() {
    let folder = folder_with_cloud();
    let at = folder.path();
    let both = untrained(&Shape::tiny().with_quick_heads(), 1);
    std::fs::write(at.join("one.safetensors"), tiny_model(1)).unwrap();
    std::fs::write(at.join("both.safetensors"), both).unwrap();
    let (one, both) = (["--model", "one.safetensors"], ["--model", "both.safetensors"]);
    let with = |arguments: &[&str], model: &[&str]| succeeds(at, &[arguments, model].concat());
    let encode = ["encode", "ball.ply", "-o", "ball.b2p"];
    with(&[&encode[..], &["--colours", "learned"]].concat(), &one);
    let decode = ["decode", "ball.b2p", "--heads", "quick", "-o"];
    with(&["decode", "ball.b2p", "-o", "best.ply"], &both);
    with(&[&decode[..], &["quick.ply"]].concat(), &both);
    let [best, quick] = ["best.ply", "quick.ply"].map(|name| std::fs::read(at.join(name)).unwrap());
    assert!(best.len() == quick.len() && best != quick);
    let render = [
        "render", "ball.b2p", "--size", "40x30", "--heads", "quick", "-o", "a.png",
    ];
    with(&render, &both);
    succeeds(at, &["render", "quick.ply", "--size", "40x30", "-o", "b.png"]);
    assert_eq!(png(&at.join("a.png")).data().len(), 4 * 40 * 30);
    let bench = ["bench", "ball.b2p", "--repeat", "1", "--heads", "quick", "--json"];
    let bench: Value = serde_json::from_str(&with(&bench, &both)).unwrap();
    assert_eq!(bench["heads"], "quick");
    let info = |model| with(&["info", "ball.b2p"], model);
    assert!(info(&one).contains("tiny, heads: best\n"));
    assert!(info(&both).contains("tiny, heads: best, quick\n"));
    assert!(succeeds(at, &["info", "ball.b2p"]).contains("not the program's own"));

    let refused = |arguments: &[&str], words: &[&str]| fails(at, arguments, words);
    let to = [&decode[..], &["x.ply"]].concat();
    refused(&[&to[..], &one].concat(), &["no quick heads"]);
    let ply = ["render", "quick.ply", "--heads", "quick", "-o", "x.png"];
    refused(&ply, &["quick.ply", "--heads"]);
}

#[test]
fn a_level_without_gaussians_is_refused_and_the_others_are_named() {
    let folder = folder_with_learned_stream();
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
    fails(at, &["encode", "noise.ply", "-o", "x.b2p"], &["noise.ply", "ply"]);
    fails(at, &["encode", "absent.ply", "-o", "x.b2p"], &["absent.ply"]);

    let header = |properties: &str, count: usize| {
        format!("ply\nformat ascii 1.0\nelement vertex {count}\n{properties}end_header\n")
    };
    let xyz = "property float x\nproperty float y\nproperty float z\n";
    let rgb = "property uchar red\nproperty uchar green\nproperty uchar blue\n";
    std::fs::write(at.join("grey.ply"), header(xyz, 1) + "1 2 3\n").unwrap();
    fails(
        at,
        &["encode", "grey.ply", "-o", "x.b2p", "--strict"],
        &["grey.ply", "no colours"],
    );
    let coloured = header(&format!("{xyz}{rgb}"), 2);
    std::fs::write(at.join("nan.ply"), format!("{coloured}1 2 3 4 5 6\n1 nan 3 4 5 6\n")).unwrap();
    fails(
        at,
        &["encode", "nan.ply", "-o", "x.b2p", "--strict"],
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

    fails(at, &["decode", "ball.ply", "-o", "x.ply"], &["ball.ply", "b2p"]);
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
    let folder = folder_with_learned_stream();
    let at = folder.path();
    std::fs::write(at.join("other.safetensors"), tiny_model(1)).unwrap();
    let arguments = ["decode", "ball.b2p", "-o", "x.ply", "--model", "other.safetensors"];
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
    for colours in ["transform", "learned"] {
        drawn_like_a_file(folder_coded(colours).path());
    }
}

fn drawn_like_a_file(at: &Path) {
    let stream = std::fs::read(at.join("ball.b2p")).unwrap();
    let size = ["--size", "48x32"];
    succeeds(at, &[&["render", "ball.b2p", "-o", "file.png"], &size[..]].concat());
    let done = piped(at, &[&["render", "-", "-o", "pipe.png"], &size[..]].concat(), &stream);
    assert!(done.status.success());
    let [file, pipe] = ["file.png", "pipe.png"].map(|name| std::fs::read(at.join(name)).unwrap());
    assert!(file == pipe);
    let done = piped(at, &[&["render", "-", "-o", "-"], &size[..]].concat(), &stream);
    assert!(done.stdout == file, "one picture on standard output, the finest");

    succeeds(at, &["decode", "ball.b2p", "-o", "file.ply"]);
    assert!(piped(at, &["decode", "-", "-o", "pipe.ply"], &stream).status.success());
    let [file, pipe] = ["file.ply", "pipe.ply"].map(|name| std::fs::read(at.join(name)).unwrap());
    assert!(file == pipe);
    let done = piped(at, &[&["render", "-", "-o", "g.png"], &size[..]].concat(), &file);
    assert!(done.status.success(), "Gaussians come through a pipe too");
}

#[test]
fn a_pipe_that_breaks_off_leaves_the_finest_whole_level() {
    for colours in ["transform", "learned"] {
        breaks_off(folder_coded(colours).path());
    }
}

fn breaks_off(at: &Path) {
    let stream = std::fs::read(at.join("ball.b2p")).unwrap();
    let cut = &stream[..stream.len() - 1];
    let done = piped(at, &["decode", "-", "-o", "cut.ply"], cut);
    let told = String::from_utf8_lossy(&done.stderr).into_owned();
    assert!(done.status.success(), "{told}");
    assert!(told.contains("truncated") && told.contains("level 5"), "{told}");
    succeeds(at, &["decode", "ball.b2p", "-o", "five.ply", "--level", "5"]);
    let [cut_ply, five] = ["cut.ply", "five.ply"].map(|name| std::fs::read(at.join(name)).unwrap());
    assert!(cut_ply == five);

    let named = piped(at, &["decode", "-", "-o", "x.ply", "--level", "6"], cut);
    assert_eq!(named.status.code(), Some(1), "the level asked for is not there");
    let nothing = piped(at, &["decode", "-", "-o", "x.ply"], &stream[..100]);
    assert_eq!(nothing.status.code(), Some(1));
    let mut damaged = stream.clone();
    damaged[stream.len() - 1] ^= 1;
    let damaged = piped(at, &["decode", "-", "-o", "y.ply", "--level", "6"], &damaged);
    assert!(String::from_utf8_lossy(&damaged.stderr).contains("checksum"));
    assert!(!at.join("x.ply").exists() && !at.join("y.ply").exists());
}

#[test]
fn limits_can_be_set_and_say_how_to_raise_them() {
    let folder = folder_with_stream();
    let at = folder.path();
    let decode = ["decode", "ball.b2p", "-o", "x.ply"];
    for limit in [["--max-memory", "1M"], ["--max-points", "10"]] {
        fails(at, &[&decode[..], &limit].concat(), &["ball.b2p", "limit of", limit[0]]);
    }
    let render = ["render", "ball.b2p", "-o", "x.png"];
    let few = ["--max-pixels", "1000"];
    fails(at, &[&render[..], &few].concat(), &["1048576", "--max-pixels"]);
    let roomy = ["--limits", "embedded", "--max-memory", "1G"];
    succeeds(at, &[&decode[..], &roomy].concat());
}
