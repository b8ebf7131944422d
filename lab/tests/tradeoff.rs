//! `b2p-lab tradeoff` from outside: the page's structure, and what must hold whatever the machine.

#[path = "../../tests/common/mod.rs"]
mod common;

use std::process::Command;

use common::Ball;
use serde_json::Value;

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
    let output = Command::new(env!("CARGO_BIN_EXE_b2p-lab"))
        .current_dir(at)
        .args(arguments)
        .output()
        .expect("the program starts");
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{errors}");
    let text = String::from_utf8(output.stdout).expect("output is UTF-8");
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
        "Computation",
        "Truth",
        "SSIMULACRA2",
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
        assert!(row["truth"]["psnr"].as_f64().unwrap() > 10.0, "{row}");
    }
    let of = |knob: &str, what: &str, value: Value| {
        let mut rows = ladder.iter();
        let row = rows.find(|row| row["knob"] == knob && row[what] == value);
        decibel(row.unwrap_or(default))
    };
    // A coarser level, thinner heads, a smaller picture, a higher minimum α: none is nearer to the truth.
    assert!(of("heads", "heads", "quick".into()) < decibel(default));
    assert!(of("heads", "heads", "surfels".into()) < decibel(default));
    assert!(of("precision", "precision", "f16".into()) > decibel(default));
    assert_eq!(report["truth"], "cloud");
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
    let accuracy = |row: &Value| (10.0 * row["truth"]["psnr"].as_f64().unwrap()).round();
    for (front, time) in [("on_front", "total"), ("on_picture_front", "picture")] {
        let mut members: Vec<(f64, f64)> = combinations
            .iter()
            .filter(|row| row[front] == true)
            .map(|row| (row[time]["median"].as_f64().unwrap(), accuracy(row)))
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
