//! Many inputs: all are worked on, whatever becomes of some; nothing is done twice that was done.

use std::path::Path;
use std::process::Output;

use serde_json::Value;
use tempfile::TempDir;

use super::common::{Ball, names_in};
use super::{fails, plain, succeeds};

/// A folder with clouds a, b and c in `clouds`.
fn clouds() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("clouds")).unwrap();
    for (name, radius) in [("a", 8.0), ("b", 9.0), ("c", 10.0)] {
        let cloud = Ball::new(7, 3.0 * radius).to_ply();
        std::fs::write(folder.path().join("clouds").join(format!("{name}.ply")), cloud).unwrap();
    }
    folder
}

fn lines(output: &Output) -> Vec<Value> {
    let text = String::from_utf8(output.stdout.clone()).unwrap();
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

fn bytes(folder: &Path, name: &str) -> Vec<u8> {
    std::fs::read(folder.join(name)).unwrap()
}

#[test]
fn a_folder_a_pattern_and_a_list_are_all_the_same_files() {
    let folder = clouds();
    let at = folder.path();
    std::fs::write(at.join("list"), "clouds/a.ply\nclouds/b.ply\n\nclouds/c.ply\n").unwrap();
    succeeds(at, &["encode", "clouds", "-o", "one"]);
    succeeds(at, &["encode", "clouds/?.ply", "two/"]);
    succeeds(at, &["encode", "--files-from", "list", "three"]);
    succeeds(
        at,
        &[
            "encode",
            "clouds/a.ply",
            "clouds/b.ply",
            "clouds/c.ply",
            "-o",
            "four",
            "--jobs",
            "1",
        ],
    );
    succeeds(at, &["encode", "clouds/b.ply", "alone.b2p"]);
    for other in ["two", "three", "four"] {
        assert_eq!(names_in(&at.join(other)), ["a.b2p", "b.b2p", "c.b2p"]);
        for name in ["a.b2p", "b.b2p", "c.b2p"] {
            assert!(
                bytes(&at.join("one"), name) == bytes(&at.join(other), name),
                "{other}/{name}"
            );
        }
    }
    assert!(bytes(&at.join("one"), "b.b2p") == bytes(at, "alone.b2p"));
}

#[test]
fn one_that_fails_is_named_and_the_others_are_done() {
    let folder = clouds();
    let at = folder.path();
    std::fs::write(at.join("clouds/b.ply"), "ply\nformat ascii 1.0\nnonsense\n").unwrap();
    let output = plain(at, &["encode", "clouds", "-o", "out"]);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{errors}");
    assert!(errors.contains("b2p: clouds/b.ply: "), "{errors}");
    assert!(errors.contains("1 of 3 files failed"), "{errors}");
    assert_eq!(names_in(&at.join("out")), ["a.b2p", "c.b2p"]);
}

#[test]
fn what_is_up_to_date_is_skipped_by_its_contents() {
    let folder = clouds();
    let at = folder.path();
    let run = |more: &[&str]| {
        let output = plain(
            at,
            &[
                &["encode", "clouds", "-o", "out", "--resume", "--progress", "json"],
                more,
            ]
            .concat(),
        );
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let ends = lines(&output).into_iter().filter(|event| event["event"] == "end");
        let mut ends: Vec<_> = ends
            .map(|event| {
                format!(
                    "{} {}",
                    event["input"].as_str().unwrap(),
                    event["status"].as_str().unwrap()
                )
            })
            .collect();
        ends.sort();
        ends.join(", ")
    };
    let all = |status: &str| format!("clouds/a.ply {status}, clouds/b.ply {status}, clouds/c.ply {status}");
    assert_eq!(run(&[]), all("done"));
    assert_eq!(run(&[]), all("skipped"));
    // What is said of threads and reports changes nothing; other options do.
    assert_eq!(run(&["--threads", "1", "-v"]), all("skipped"));
    assert_eq!(run(&["--step", "30"]), all("done"));
    assert_eq!(run(&["--step", "30"]), all("skipped"));
    // A damaged output, and a changed input.
    let a = bytes(at, "out/a.b2p");
    std::fs::write(at.join("out/a.b2p"), &a[..a.len() - 1]).unwrap();
    std::fs::copy(at.join("clouds/c.ply"), at.join("clouds/b.ply")).unwrap();
    assert_eq!(
        run(&["--step", "30"]),
        "clouds/a.ply done, clouds/b.ply done, clouds/c.ply skipped"
    );
    assert!(bytes(at, "out/a.b2p") == a);
    // The same of one file.
    succeeds(at, &["encode", "clouds/a.ply", "a.b2p", "--resume"]);
    let output = plain(at, &["encode", "clouds/a.ply", "a.b2p", "--resume"]);
    assert!(output.status.success());
    assert!(String::from_utf8_lossy(&output.stderr).contains("a.b2p is up to date"));
}

#[test]
fn pictures_and_gaussians_of_many_streams_are_those_of_each() {
    let folder = clouds();
    let at = folder.path();
    succeeds(at, &["encode", "clouds", "-o", "streams"]);
    let heads = ["--heads", "surfels"];
    succeeds(
        at,
        &[&["decode", "streams", "-o", "gaussians", "--format", "spz"][..], &heads].concat(),
    );
    assert_eq!(names_in(&at.join("gaussians")), ["a.spz", "b.spz", "c.spz"]);
    let draw = ["--size", "40x30", "--views", "2"];
    succeeds(
        at,
        &[
            &[
                "render",
                "streams/a.b2p",
                "streams/b.b2p",
                "pictures/",
                "--name",
                "{n}-{stem}.ppm",
            ][..],
            &heads,
            &draw,
        ]
        .concat(),
    );
    let pictures = [
        "000000-a-000.ppm",
        "000000-a-001.ppm",
        "000001-b-000.ppm",
        "000001-b-001.ppm",
    ];
    assert_eq!(names_in(&at.join("pictures")), pictures);
    succeeds(at, &[&["render", "streams/b.b2p", "b.ppm"][..], &heads, &draw].concat());
    assert!(bytes(at, "b-001.ppm") == bytes(at, "pictures/000001-b-001.ppm"));
    succeeds(
        at,
        &[
            &["render", "streams", "--turntable", "turns/", "--name", "{stem}.gif"][..],
            &heads,
            &draw,
        ]
        .concat(),
    );
    assert_eq!(names_in(&at.join("turns")), ["a.gif", "b.gif", "c.gif"]);
}

#[test]
fn inputs_that_are_not_there_and_outputs_that_collide_are_said_before_any_work() {
    let folder = clouds();
    let at = folder.path();
    std::fs::create_dir(at.join("more")).unwrap();
    std::fs::copy(at.join("clouds/a.ply"), at.join("more/a.ply")).unwrap();
    fails(
        at,
        &["encode", "clouds/x*.ply", "-o", "out"],
        &["clouds/x*.ply", "no file has such a name"],
    );
    fails(
        at,
        &["decode", "clouds", "-o", "out"],
        &["clouds: no files that end with .b2p"],
    );
    fails(
        at,
        &["encode", "clouds", "more", "-o", "out"],
        &["clouds/a.ply and more/a.ply would both become out/a.b2p", "--name"],
    );
    fails(
        at,
        &["decode", "clouds/a.ply", "clouds/b.ply", "-o", "out.ply"],
        &["out.ply is no folder", "-o out/"],
    );
}
