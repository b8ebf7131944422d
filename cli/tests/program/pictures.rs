//! `b2p demo`, `b2p render` and `b2p bench --render`.

use super::*;

#[test]
fn the_demo_writes_gaussians_of_each_level_and_pictures_of_them() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let report = succeeds(at, &["demo"]);
    let demo = at.join("b2p-demo");
    for level in [7, 8, 9] {
        let written = [".ply", "-front.png", "-close.png"].map(|end| format!("level-{level}{end}"));
        for name in &written {
            assert!(
                report.contains(&format!("b2p-demo/{name}")),
                "{name} should be reported: {report}"
            );
        }
        let [front, close] = ["front", "close"].map(|view| png(&demo.join(format!("level-{level}-{view}.png"))));
        assert!(front.data() != close.data());
        // Gaussians are drawn like those of any file.
        succeeds(&demo, &["render", &written[0], "-o", "again.png", "--size", "64x64"]);
    }
    assert_eq!(names_in(&demo).len(), 10);
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
    let pictures: Vec<_> = (0..3).map(|i| png(&at.join(format!("turn-{i:03}.png")))).collect();
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
        String::from_utf8(done.stderr).unwrap()
    };
    assert!(draw("a.png", &[]).contains("antialias off: "));
    assert!(draw("b.png", &["--effect", "antialias=on"]).contains("antialias on: forced"));
    let [a, b] = ["a.png", "b.png"].map(|name| png(&at.join(name)));
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
    // The base level of a learned stream has no Gaussians.
    for (colours, coarsest) in [("transform", 4), ("learned", 5)] {
        let folder = folder_coded(colours);
        let draw = |more: &[&str]| {
            let args = ["render", "ball.b2p", "-o", "a.png", "-v", "--orbit", "0,0,3"];
            succeeds(folder.path(), &[&args[..], more].concat())
        };
        let small = draw(&["--size", "8x8"]);
        assert!(small.contains(&format!("detail on: level {coarsest}")), "{small}");
        assert!(draw(&["--size", "400x400"]).contains("detail off: as fine as there is"));
        assert!(draw(&["--size", "8x8", "--level", "6"]).contains("detail off: level 6, forced"));
    }
}

#[test]
fn drawing_is_timed_stage_by_stage() {
    let folder = folder_with_stream();
    let args = ["bench", "ball.b2p", "--render", "--size", "64x48", "--repeat", "2"];
    assert!(succeeds(folder.path(), &args).contains("blend"));
    let json = succeeds(folder.path(), &[&args[..], &["--json"]].concat());
    let json: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!((json["width"].as_u64(), json["runs"].as_u64()), (Some(64), Some(2)));
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
        let text = format!(r#"{{"camera_angle_x": 0.8, "frames": [{}]}}"#, shots.join(","));
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
    assert_eq!(png(&at.join("f-001.png")).width(), 16);
    file(&[shot(1.5)]);
    let done = b2p(at, &args);
    assert_eq!(done.status.code(), Some(1));
    let error = String::from_utf8(done.stderr).unwrap();
    assert!(error.contains("transforms.json") && error.contains("scales"), "{error}");
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
    let picture = png(&at.join("t.png"));
    assert_eq!(picture.pixel(0, 0).map(|p| p.alpha()), Some(0));
    assert_eq!(picture.pixel(32, 32).map(|p| p.alpha()), Some(255));
}
