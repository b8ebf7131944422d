//! `b2p tradeoff` and budgets from outside: the page's structure, and what must hold whatever the machine.
#![cfg(feature = "cli")]

mod common;

use std::path::Path;
use std::process::{Command, Output};

use b2p::network::{Shape, untrained};
use common::Ball;
use serde_json::Value;

/// The program with a cache folder of its own.
fn b2p(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_b2p"))
        .current_dir(folder)
        .env("XDG_CACHE_HOME", folder.join("cache"))
        .args(arguments)
        .output()
        .expect("the program starts")
}

#[track_caller]
fn succeeds(folder: &Path, arguments: &[&str]) -> String {
    let output = b2p(folder, arguments);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{arguments:?} failed: {errors}");
    String::from_utf8(output.stdout).expect("output is UTF-8")
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

/// A row's error, or its accuracy where pictures are equal.
fn decibel(row: &Value) -> f64 {
    row["psnr"].as_f64().unwrap_or(f64::INFINITY)
}

#[test]
fn the_page_has_all_its_parts_and_more_precise_is_never_less_accurate() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    std::fs::write(at.join("ball.ply"), Ball::new(7, 40.0).to_ply()).unwrap();
    let arguments = [
        "tradeoff", "ball.ply", "-o", "out", "--views", "1", "--size", "168x168", "--repeat", "2",
    ];
    let text = succeeds(at, &arguments);
    assert!(text.contains("one knob at a time") && text.contains("tradeoff.html"));

    let read = |name: &str| std::fs::read_to_string(at.join("out").join(name)).unwrap();
    let page = read("tradeoff.html");
    for part in [
        "<svg",
        "One knob at a time",
        "Combinations",
        "By stage",
        "worst pixels",
        "Hard cases",
        "Effects",
        "data:image/png;base64,",
        "PSNR, cloud",
    ] {
        assert!(page.contains(part), "the page lacks {part}");
    }
    assert!(!page.contains("<script") && !page.contains("src=\"http"));
    assert!(read("tradeoff.svg").starts_with("<svg"));

    let report: Value = serde_json::from_str(&read("tradeoff.json")).unwrap();
    let ladder = report["ladder"].as_array().unwrap();
    let default = &ladder[0];
    assert_eq!(default["knob"], "default");
    for knob in ["level", "heads", "precision", "quality", "size", "isa"] {
        assert!(ladder.iter().any(|row| row["knob"] == knob), "{knob}");
    }
    for row in ladder {
        for time in ["decode", "picture", "total"] {
            let at = |name: &str| row[time][name].as_f64().unwrap();
            let (low, median, high) = (at("low"), at("median"), at("high"));
            assert!(0.0 < low && low <= median && median <= high, "{row}");
        }
        assert_eq!(row["stages"].as_object().unwrap().len(), 8);
        assert!(decibel(row) > 10.0, "{row}");
        assert!(row["cloud_psnr"].as_f64().unwrap() > 10.0, "{row}");
    }
    let of = |knob: &str, what: &str, value: Value| {
        let mut rows = ladder.iter();
        let row = rows.find(|row| row["knob"] == knob && row[what] == value);
        decibel(row.unwrap_or(default))
    };
    // A coarser level, thinner heads, a smaller picture, a higher floor of α: none is nearer to the truth.
    assert!(of("heads", "heads", "quick".into()) < decibel(default));
    assert!(of("level", "level", 5.into()) < decibel(default));
    assert!(of("size", "size", vec![84, 84].into()) < decibel(default));
    assert!(of("size", "size", vec![42, 42].into()) < of("size", "size", vec![84, 84].into()));
    // Equal but for rounding.
    let slack = 0.05;
    let qualities = ["floor 1/64", "fast", "floor 1/1024", "fine", "exact"];
    let qualities = qualities.map(|name| of("quality", "quality", name.into()));
    for pair in qualities.windows(2) {
        assert!(pair[1] >= pair[0] - slack, "{qualities:?}");
    }
    for row in ladder.iter().filter(|row| row["knob"] == "threads") {
        assert_eq!(decibel(row), decibel(default), "threads change no bit");
    }
    for row in ladder.iter().filter(|row| row["knob"] == "isa") {
        let apart = decibel(row) - decibel(default);
        assert!(apart.abs() < 0.5, "instructions change last bits alone: {row}");
    }

    let combinations = report["combinations"].as_array().unwrap();
    let fronts = ["on_front", "on_picture_front"];
    for (front, time) in fronts.into_iter().zip(["total", "picture"]) {
        let mut members: Vec<(f64, f64)> = combinations
            .iter()
            .filter(|row| row[front] == true)
            .map(|row| (row[time]["median"].as_f64().unwrap(), decibel(row)))
            .collect();
        members.sort_by(|a, b| a.0.total_cmp(&b.0));
        assert!(!members.is_empty());
        assert!(members.windows(2).all(|w| w[0].1 <= w[1].1), "{members:?}");
    }

    let worst = |case: &Value, setting: &str| {
        let errors = case["errors"].as_array().unwrap();
        let error = errors.iter().find(|e| e["setting"] == setting);
        error.unwrap_or_else(|| panic!("no {setting}: {case}"))["worst"]
            .as_f64()
            .unwrap()
    };
    let cases = report["renderer_cases"].as_array().unwrap();
    assert!(cases.len() >= 9);
    for case in cases {
        assert!(worst(case, "exact") <= 2.0, "{case}");
        assert!(worst(case, "exact") <= worst(case, "fast") + 0.3, "{case}");
    }
    let layers = cases.iter().find(|case| case["name"] == "1000 layers of 1/300");
    let layers = layers.expect("the layers are there");
    assert!(worst(layers, "fast") > 100.0, "fast leaves all of them out");
    assert!(report["network_cases"].as_array().unwrap().len() >= 5);

    let effects = report["effects"].as_array().unwrap();
    let on = |scene: &str| {
        let mut rows = effects.iter().filter(|row| row["scene"] == scene);
        rows.all(|row| row["called_for"] == true)
    };
    assert!(on("view-dependent colour of degree 3") && on("made for it"));
    assert!(on("from within the surface") && on("made for it, 0.4 px wide"));
    assert!(!on("plain colour") && !on("the stream"));
}

#[test]
fn a_budget_chooses_says_so_and_measures_once() {
    let folder = folder_with_stream();
    let at = folder.path();
    let model = ["--model", "tiny.safetensors"];
    let decode = ["decode", "ball.b2p", "-o", "ball-g.ply"];
    let with = |more: &[&str]| succeeds(at, &[&decode[..], &model, more].concat());
    let ample = with(&["--budget", "1000s"]);
    assert!(ample.starts_with("budget: level 5, "), "{ample}");
    assert!(ample.contains("; kept: "), "{ample}");
    assert!(!ample.contains("nothing promises"), "{ample}");
    let kept = || {
        let files = std::fs::read_dir(at.join("cache/b2p")).unwrap();
        let files: Vec<_> = files.map(|f| f.unwrap().path()).collect();
        assert_eq!(files.len(), 1);
        std::fs::read(&files[0]).unwrap()
    };
    let first = kept();
    // Nothing keeps a microsecond; the fastest is taken, and the program says that it was not enough.
    let hopeless = with(&["--budget", "0.001ms"]);
    let told = "nothing promises 0.0 ms; not kept: ";
    assert!(hopeless.contains(told), "{hopeless}");
    assert!(kept() == first, "measured once");
    let accurate = with(&["--min-psnr", "199"]);
    assert!(accurate.contains("not the 199 dB asked for"), "{accurate}");
    with(&["--budget", "1s", "--calibrate"]);
    assert!(kept() != first, "measured anew");

    let render = ["render", "ball.b2p", "-o", "a.png", "--size", "64x48"];
    let drawn = succeeds(
        at,
        &[&render[..], &model, &["--budget", "1000s", "--min-psnr", "1"]].concat(),
    );
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
    let costly = sound.replace("\"start\":", "\"start\": 1e300, \"begin\":");
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
    misuse(&[&decode[..], &["1s", "--heads", "quick"]].concat());
    misuse(&[&decode[..], &["33"]].concat());
    let render = ["render", "ball.b2p", "-o", "x.png", "--quality", "exact"];
    misuse(&[&render[..], &["--min-psnr", "40"]].concat());

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
