//! Sequences through the program: coded from many clouds, described, checked, cut, joined, decoded and drawn.

use std::path::Path;

use b2p::{Limits, SequenceReader};
use serde_json::Value;
use tempfile::TempDir;

use super::common::{Ball, names_in};
use super::{b2p, fails, piped, plain, succeeds};

/// Six frames of a ball that moves by a voxel, named as `frame_%02d.ply` from 0 on.
fn frames() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("frames")).unwrap();
    for frame in 0..6u32 {
        let mut text = String::from("ply\nformat ascii 1.0\ncomment bits 6\n");
        let voxels = Ball::new(6, 14.0).voxels();
        text += &format!("element vertex {}\n", voxels.len());
        text += "property float x\nproperty float y\nproperty float z\n";
        text += "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n";
        for ([x, y, z], [r, g, b]) in voxels {
            text += &format!("{} {y} {z} {r} {g} {b}\n", x + frame);
        }
        std::fs::write(folder.path().join(format!("frames/frame_{frame:02}.ply")), text).unwrap();
    }
    folder
}

const CODING: [&str; 6] = ["--gop", "3", "--fps", "25", "--levels", "3..5"];

fn encode(at: &Path, inputs: &[&str], output: &str, more: &[&str]) {
    succeeds(at, &[&["encode"], inputs, &["-o", output], &CODING, more].concat());
}

fn bytes(at: &Path, name: &str) -> Vec<u8> {
    std::fs::read(at.join(name)).unwrap()
}

#[test]
fn a_folder_a_pattern_and_a_list_of_files_make_the_same_sequence() {
    let folder = frames();
    let at = folder.path();
    encode(at, &["frames"], "a.b2p", &[]);
    encode(at, &["frames/frame_%02d.ply"], "b.b2p", &[]);
    let names: Vec<String> = (0..6).map(|i| format!("frames/frame_{i:02}.ply")).collect();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    encode(at, &names, "c.b2p", &["--threads", "1"]);
    let output = plain(at, &[&["encode", "frames", "-o", "-"][..], &CODING].concat());
    assert!(output.status.success());
    for other in [bytes(at, "b.b2p"), bytes(at, "c.b2p"), output.stdout] {
        assert!(bytes(at, "a.b2p") == other);
    }
    let info: Value = serde_json::from_str(&succeeds(at, &["info", "a.b2p", "--json"])).unwrap();
    assert_eq!(info["frames"], 6, "{info}");
    let sequence = SequenceReader::new(bytes(at, "a.b2p"), &Limits::default()).unwrap();
    for (number, said) in info["groups"].as_array().unwrap().iter().enumerate() {
        let group = sequence.group(number).unwrap();
        let count = |is: &dyn Fn(usize) -> bool| (0..group.len()).filter(|at| is(*at)).count();
        assert_eq!(said["whole"], count(&|at| group.is_whole(at)), "{info}");
        assert_eq!(said["warped"], count(&|at| group.is_warped(at)), "{info}");
    }
    succeeds(at, &["check", "a.b2p"]);
}

#[test]
fn bench_of_a_sequence_says_what_its_frames_take() {
    let folder = frames();
    let at = folder.path();
    encode(at, &["frames"], "a.b2p", &[]);
    let args = [
        "bench", "a.b2p", "--repeat", "2", "--level", "4", "--heads", "surfels", "--json",
    ];
    let bench: Value = serde_json::from_str(&succeeds(at, &args)).unwrap();
    assert_eq!(
        (&bench["frames"], &bench["level"], &bench["heads"]),
        (&6.into(), &4.into(), &"surfels".into())
    );
    let time = |name: &str| bench[name].as_f64().unwrap();
    assert!(time("voxels_ms") > 0.0 && time("gaussians_ms") > 0.0, "{bench}");
    assert!(bench["stages"].as_array().is_some_and(|stages| !stages.is_empty()));
    let said = succeeds(at, &["bench", "a.b2p", "--repeat", "1"]);
    assert!(said.contains("6 frames, level 5") && said.contains("a frame"), "{said}");
    // Nothing is timed of a sequence with a fault.
    let mut damaged = bytes(at, "a.b2p");
    let last = damaged.len() - 3;
    damaged[last] ^= 1;
    std::fs::write(at.join("damaged.b2p"), damaged).unwrap();
    fails(at, &["bench", "damaged.b2p"], &["damaged.b2p", "damaged"]);
}

#[test]
fn a_check_of_a_damaged_sequence_names_the_clause_that_it_breaks() {
    let folder = frames();
    let at = folder.path();
    encode(at, &["frames"], "a.b2p", &[]);
    let whole = bytes(at, "a.b2p");
    for (end, clause) in [(90, "2.2.1"), (130, "17.1.1"), (whole.len() - 1, "17.2.3")] {
        std::fs::write(at.join("cut.b2p"), &whole[..end]).unwrap();
        let output = b2p(at, &["check", "cut.b2p"]);
        let said = String::from_utf8(output.stdout).unwrap();
        assert_eq!(output.status.code(), Some(1), "{said}");
        assert!(
            said.contains("cut.b2p: ") && said.contains(&format!("clause {clause}")),
            "{said}"
        );
    }
    // The last byte is of the colours of the last frame's finest level.
    let mut damaged = whole.clone();
    let last = damaged.len() - 1;
    damaged[last] ^= 1;
    std::fs::write(at.join("damaged.b2p"), damaged).unwrap();
    let output = b2p(at, &["check", "a.b2p", "damaged.b2p"]);
    let said = String::from_utf8(output.stdout).unwrap();
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("a.b2p: valid, 6 frames"), "{said}");
    assert!(
        said.contains("damaged.b2p: not valid: 2 faults, 6 frames\n  clause 17.2.3, byte "),
        "{said}"
    );
    assert!(said.contains("  clause 3.1.1, frame 5, level "), "{said}");
    let output = b2p(at, &["check", "damaged.b2p", "--json"]);
    let said: Value = serde_json::from_slice(&output.stdout).unwrap();
    let fault = &said[0]["faults"][1];
    assert_eq!(
        (&said[0]["valid"], &fault["frame"], &fault["clause"]),
        (&false.into(), &5.into(), &"3.1.1".into())
    );
    let place = fault["offset"].as_u64().unwrap() as usize;
    assert!(place < last && place > last / 2 && fault["level"].is_u64(), "{said}");
}

#[test]
fn parts_of_a_sequence_are_cut_joined_decoded_and_drawn() {
    let folder = frames();
    let at = folder.path();
    encode(at, &["frames"], "all.b2p", &[]);
    succeeds(at, &["cut", "all.b2p", "-o", "first.b2p", "--frames", "0..3"]);
    succeeds(at, &["cut", "all.b2p", "-o", "rest.b2p", "--frames", "3..6"]);
    succeeds(at, &["join", "first.b2p", "rest.b2p", "-o", "joined.b2p"]);
    assert!(bytes(at, "all.b2p") == bytes(at, "joined.b2p"));

    let surfels = ["--heads", "surfels"];
    succeeds(
        at,
        &[&["decode", "all.b2p", "-o", "four.ply", "--frame", "4"][..], &surfels].concat(),
    );
    succeeds(
        at,
        &[&["decode", "rest.b2p", "-o", "one.ply", "--time", "0.05"][..], &surfels].concat(),
    );
    assert!(
        bytes(at, "four.ply") == bytes(at, "one.ply"),
        "the second frame of the rest"
    );
    let draw = ["--size", "40x30"];
    succeeds(
        at,
        &[&["render", "all.b2p", "-o", "%d.png"][..], &surfels, &draw].concat(),
    );
    assert_eq!(
        names_in(at)
            .iter()
            .filter(|name| name.to_string_lossy().ends_with(".png"))
            .count(),
        6
    );
    succeeds(
        at,
        &[&["render", "all.b2p", "-o", "all.y4m"][..], &surfels, &draw].concat(),
    );
    assert_eq!(
        bytes(at, "all.y4m").windows(5).filter(|part| part == b"FRAME").count(),
        6
    );
    for (name, start) in [
        ("all.gif", &b"GIF89a"[..]),
        ("all.webp", b"RIFF"),
        ("all.apng", b"\x89PNG"),
    ] {
        succeeds(at, &[&["render", "all.b2p", "-o", name][..], &surfels, &draw].concat());
        assert!(bytes(at, name).starts_with(start), "{name}");
    }
    let refused = &[&["render", "all.b2p", "-o", "all.png"][..], &surfels, &draw].concat();
    fails(at, refused, &["all.png", ".gif", "%04d"]);
    fails(at, &["cut", "all.b2p", "-o", "x.b2p", "--frames", "1..3"], &["all.b2p"]);
}

#[test]
fn a_sequence_on_standard_input_is_read_as_one_in_a_file() {
    let folder = frames();
    let at = folder.path();
    encode(at, &["frames"], "all.b2p", &[]);
    let sequence = bytes(at, "all.b2p");
    let surfels = ["--heads", "surfels"];
    succeeds(
        at,
        &[&["decode", "all.b2p", "-o", "file_%d.ply"][..], &surfels].concat(),
    );
    let run = piped(
        at,
        &[&["decode", "-", "-o", "pipe_%d.ply"][..], &surfels].concat(),
        &sequence,
    );
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    for i in 0..6 {
        assert!(
            bytes(at, &format!("file_{i}.ply")) == bytes(at, &format!("pipe_{i}.ply")),
            "{i}"
        );
    }
    let draw = [&["render", "-", "-o", "pipe.gif", "--size", "40x30"][..], &surfels].concat();
    assert!(piped(at, &draw, &sequence).status.success());
    assert!(bytes(at, "pipe.gif").starts_with(b"GIF89a"));
    for command in [
        &["info", "-"][..],
        &["check", "-"],
        &["cut", "-", "-o", "cut.b2p", "--frames", "0..3"],
    ] {
        let run = piped(at, command, &sequence);
        assert!(
            run.status.success(),
            "{command:?}: {}",
            String::from_utf8_lossy(&run.stderr)
        );
    }
}

#[test]
fn a_sequence_is_drawn_upright() {
    let folder = frames();
    let at = folder.path();
    encode(at, &["frames"], "z.b2p", &["--up", "z"]);
    let draw = |name: &str, more: &[&str]| {
        let picture = [
            "--frame", "2", "--size", "40x30", "--orbit", "10,30", "--heads", "surfels",
        ];
        succeeds(at, &[&["render", "z.b2p", "-o", name][..], &picture, more].concat());
        bytes(at, name)
    };
    let known = draw("known.png", &[]);
    assert!(known == draw("z.png", &["--up", "z"]));
    assert!(known != draw("y.png", &["--up", "y"]));
}

#[cfg(unix)]
#[test]
fn a_run_that_was_killed_goes_on_with_the_groups_that_it_has_coded() {
    let folder = frames();
    let at = folder.path();
    encode(at, &["frames"], "whole.b2p", &[]);
    // No file may be larger than a block less than the sequence: the groups are written, the sequence is not.
    let blocks = bytes(at, "whole.b2p").len().div_ceil(512) - 1;
    let coding = CODING.join(" ");
    let program = env!("CARGO_BIN_EXE_b2p");
    let command = format!("ulimit -f {blocks}; exec {program} encode frames -o a.b2p --resume {coding}");
    let killed = std::process::Command::new("sh")
        .current_dir(at)
        .args(["-c", &command])
        .output();
    assert!(!killed.unwrap().status.success());
    assert_eq!(names_in(&at.join(".b2p/a.b2p.groups")).len(), 2);
    assert!(!at.join("a.b2p").exists());
    // The second group is damaged.
    let kept = names_in(&at.join(".b2p/a.b2p.groups"));
    std::fs::write(at.join(".b2p/a.b2p.groups").join(&kept[1]), b"damaged").unwrap();
    let more = ["--resume", "--json"];
    let said = succeeds(at, &[&["encode", "frames", "-o", "a.b2p"], &CODING[..], &more].concat());
    let said: Value = serde_json::from_str(&said).unwrap();
    assert_eq!(said["frames_kept"], 3, "{said}");
    assert!(bytes(at, "a.b2p") == bytes(at, "whole.b2p"));
    assert!(!at.join(".b2p/a.b2p.groups").exists());
    // The groups of trials are those of this run.
    let rate = ["--resume", "--json", "--bitrate", "1M"];
    let said = succeeds(at, &[&["encode", "frames", "-o", "b.b2p"], &CODING[..], &rate].concat());
    let said: Value = serde_json::from_str(&said).unwrap();
    assert_eq!(said["frames_kept"], 0, "{said}");
}

#[test]
fn options_of_sequences_are_kept_to() {
    let folder = frames();
    let at = folder.path();
    let size = |more: &[&str]| {
        encode(at, &["frames"], "x.b2p", more);
        bytes(at, "x.b2p").len()
    };
    let usual = size(&[]);
    assert!(usual < size(&["--intra"]), "frames are predicted");
    assert!(usual < size(&["--lossless"]));
    // Six frames last 0.24 s.
    let most = usual * 8 * 9 / 10;
    let rate = (most as f64 / 0.24) as u64;
    assert!(size(&["--bitrate", &rate.to_string()]) * 8 <= most);
    let points = 6 * Ball::new(6, 14.0).voxels().len();
    assert!(size(&["--bits-per-point", "1.5"]) as f64 * 8.0 <= 1.5 * points as f64);
    fails(
        at,
        &["encode", "frames/frame_00.ply", "-o", "y.b2p", "--fps", "30"],
        &["--fps", "for sequences"],
    );
}
