//! Budgets from outside: what must hold whatever the machine.

#[path = "../../tests/common/mod.rs"]
mod common;

use std::path::Path;
use std::process::{Command, Output};

use b2p::latents::network::{Shape, untrained};
use common::Ball;

/// The program with a cache folder of its own.
fn b2p(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_b2p"))
        .current_dir(folder)
        .env("XDG_CACHE_HOME", folder.join("cache"))
        .args(arguments)
        .arg("--force")
        .output()
        .expect("the program starts")
}

/// The report of a command that must succeed, without warnings.
#[track_caller]
fn succeeds(folder: &Path, arguments: &[&str]) -> String {
    let output = b2p(folder, arguments);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{arguments:?} failed: {errors}");
    let report = errors.lines().filter(|line| !line.starts_with("b2p: "));
    report.map(|line| format!("{line}\n")).collect()
}

/// A folder with `ball.b2p`, and a small model `tiny.safetensors` that it is coded with.
fn folder_with_stream() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    std::fs::write(at.join("ball.ply"), Ball::new(6, 20.0).to_ply()).unwrap();
    let model = untrained(&Shape::tiny().with_quick_heads(), 1);
    std::fs::write(at.join("tiny.safetensors"), model).unwrap();
    let model = ["--model", "tiny.safetensors"];
    succeeds(
        at,
        &[
            &["encode", "ball.ply", "-o", "ball.b2p"],
            &["--colours", "learned"][..],
            &model[..],
        ]
        .concat(),
    );
    folder
}

#[test]
fn a_budget_chooses_says_so_and_measures_once() {
    let folder = folder_with_stream();
    let at = folder.path();
    let model = ["--model", "tiny.safetensors"];
    let decode = ["decode", "ball.b2p", "-o", "ball-g.ply"];
    let with = |more: &[&str]| succeeds(at, &[&decode[..], &model, more].concat());
    let ample = with(&["--budget", "1000s"]);
    assert!(ample.starts_with("budget: level 5, best, expected "), "{ample}");
    assert!(ample.contains("; kept: "), "{ample}");
    assert!(!ample.contains("no setting fits"), "{ample}");
    let kept = || {
        let files = std::fs::read_dir(at.join("cache/b2p")).unwrap();
        let files: Vec<_> = files.map(|f| f.unwrap().path()).collect();
        assert_eq!(files.len(), 1);
        std::fs::read(&files[0]).unwrap()
    };
    let first = kept();
    // No setting fits a microsecond; the fastest is taken, and the program says that it was not enough.
    let hopeless = with(&["--budget", "0.001ms"]);
    let told = "no setting fits 0.0 ms; took ";
    assert!(hopeless.contains(told), "{hopeless}");
    assert!(kept() == first, "measured once");
    let quick = with(&["--budget", "1000s", "--heads", "quick"]);
    assert!(quick.starts_with("budget: level 5, quick, "), "{quick}");
    with(&["--budget", "1s", "--calibrate"]);
    assert!(kept() != first, "measured again");

    let render = ["render", "ball.b2p", "-o", "a.png", "--size", "64x48"];
    let drawn = succeeds(at, &[&render[..], &model, &["--budget", "1000s"]].concat());
    let line = drawn.lines().find(|line| line.starts_with("budget: level 5, "));
    assert!(line.is_some_and(|l| l.contains("; kept: ")), "{drawn}");
}

#[test]
fn a_hostile_cache_harms_nobody() {
    let folder = folder_with_stream();
    let at = folder.path();
    let model = ["--model", "tiny.safetensors"];
    let arguments = ["decode", "ball.b2p", "-o", "x.ply", "--budget", "1000s"];
    let arguments = [&arguments[..], &model].concat();
    let path = {
        succeeds(at, &arguments);
        let mut files = std::fs::read_dir(at.join("cache/b2p")).unwrap();
        files.next().unwrap().unwrap().path()
    };
    let sound = std::fs::read_to_string(&path).unwrap();
    let costly = sound.replacen("\"per_pixel\": ", "\"per_pixel\": 1e300, \"x\": ", 1);
    for hostile in ["", "{\"exact\": 3}", "[[[[", &costly, &sound[..sound.len() / 2]] {
        std::fs::write(&path, hostile).unwrap();
        let text = succeeds(at, &arguments);
        assert!(text.starts_with("budget: level 5, "), "{text}");
        let again = std::fs::read_to_string(&path).unwrap();
        assert!(again != hostile, "replaced by what was measured");
    }
    // A file where the folder should be: nothing can be kept, and all else works.
    std::fs::remove_dir_all(at.join("cache")).unwrap();
    std::fs::write(at.join("cache"), "in the way").unwrap();
    let output = b2p(at, &arguments);
    assert!(output.status.success());
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(told.contains("the calibration is not kept"), "{told}");
    // No cache folder at all.
    let output = Command::new(env!("CARGO_BIN_EXE_b2p"))
        .current_dir(at)
        .env_remove("XDG_CACHE_HOME")
        .env_remove("HOME")
        .args(&arguments)
        .arg("--force")
        .output()
        .unwrap();
    assert!(output.status.success());
}

#[test]
fn a_budget_and_a_knob_exclude_each_other_and_pipes_and_gaussians_have_none() {
    let folder = folder_with_stream();
    let at = folder.path();
    let misuse = |arguments: &[&str]| {
        let output = b2p(at, arguments);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}");
    };
    let decode = ["decode", "ball.b2p", "-o", "x.ply", "--budget"];
    misuse(&[&decode[..], &["1s", "--level", "5"]].concat());
    misuse(&[&decode[..], &["1s", "--precision", "f16"]].concat());
    misuse(&[&decode[..], &["1s", "--per-voxel", "1"]].concat());
    misuse(&[&decode[..], &["33"]].concat());
    let render = ["render", "ball.b2p", "-o", "x.png", "--quality", "exact"];
    misuse(&[&render[..], &["--budget", "1s"]].concat());

    let model = ["--model", "tiny.safetensors"];
    succeeds(at, &[&["decode", "ball.b2p", "-o", "g.ply"], &model[..]].concat());
    for (input, word) in [("g.ply", "PLY"), ("-", "pipe")] {
        let arguments = ["render", input, "-o", "x.png", "--budget", "1s"];
        let output = b2p(at, &arguments);
        let told = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{told}");
        assert!(told.contains(word), "{told}");
    }
}

/// The calibration in the cache of a folder.
fn kept_calibration(at: &Path) -> std::path::PathBuf {
    let mut files = std::fs::read_dir(at.join("cache/b2p")).unwrap();
    files.next().unwrap().unwrap().path()
}

#[test]
fn streams_of_version_3_have_budgets_and_a_calibration_that_is_plainly_off_is_measured_again() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    std::fs::write(at.join("ball.ply"), Ball::new(6, 20.0).to_ply()).unwrap();
    succeeds(at, &["encode", "ball.ply", "-o", "ball.b2p", "--levels", "4..6"]);
    let decode = |more: &[&str]| {
        let arguments = ["decode", "ball.b2p", "-o", "x.ply", "--budget"];
        succeeds(at, &[&arguments[..], more].concat())
    };
    let roomy = decode(&["1000s"]);
    assert!(roomy.starts_with("budget: level 6, best, expected "), "{roomy}");
    assert!(roomy.contains("; kept: "), "{roomy}");
    let surfels = decode(&["1000s", "--heads", "surfels"]);
    assert!(surfels.starts_with("budget: level 6, surfels, expected "), "{surfels}");
    let hopeless = decode(&["0.001ms"]);
    assert!(
        hopeless.starts_with("budget: level 4, surfels, expected "),
        "{hopeless}"
    );
    assert!(hopeless.contains("; no setting fits 0.0 ms; took "), "{hopeless}");
    let render = [
        "render", "ball.b2p", "-o", "x.png", "--size", "48x32", "--budget", "1000s",
    ];
    let drawn = succeeds(at, &render);
    assert!(drawn.contains("budget: level 6, best, expected "), "{drawn}");

    // As if everything took a tenth of a second a voxel.
    let path = kept_calibration(at);
    let mut kept: serde_json::Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    for point in kept["exact"].as_array_mut().unwrap() {
        point[1] = (1e8 * point[0].as_f64().unwrap()).into();
    }
    let slow = kept.to_string();
    std::fs::write(&path, &slow).unwrap();
    assert!(!decode(&["1000s"]).contains("measured again"), "it is young");
    let file = std::fs::File::options().append(true).open(&path).unwrap();
    let hour = std::time::Duration::from_secs(3600);
    file.set_modified(std::time::SystemTime::now() - hour).unwrap();
    assert!(decode(&["1000s"]).contains("the machine was measured again"));
    assert!(std::fs::read_to_string(&path).unwrap() != slow);
    assert!(!decode(&["1000s"]).contains("measured again"));
}
