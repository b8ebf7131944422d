//! What machines and other programs do to this one: it is killed, disks are full, inputs are cut short while they are
//! read. Outputs are whole, as they were, or absent.

#![cfg(target_os = "linux")]

use std::process::Child;
use std::time::{Duration, Instant};

use super::*;

/// A command, and the output that it writes.
type Job = (&'static [&'static str], &'static str);

/// A folder with a ball as text, as binary PLY, as a stream, and as a scene.
fn folder() -> tempfile::TempDir {
    let folder = folder_with_stream();
    let at = folder.path();
    succeeds(at, &["convert", "ball.ply", "-o", "binary.ply", "--points"]);
    succeeds(at, &[&["encode", "ball.ply", "-o", "scene.b2p"][..], &BLOCKS].concat());
    folder
}

const BLOCKS: [&str; 6] = ["--bits", "7", "--levels", "4..6", "--block-size", "2000"];

const JOBS: [Job; 6] = [
    (&["encode", "ball.ply", "-o", "out.b2p"], "out.b2p"),
    (
        &[
            "encode",
            "binary.ply",
            "-o",
            "out.b2p",
            "--max-memory",
            "1M",
            "--bits",
            "7",
            "--block-size",
            "2000",
        ],
        "out.b2p",
    ),
    (
        &["decode", "ball.b2p", "-o", "out.ply", "--heads", "surfels"],
        "out.ply",
    ),
    (&["decode", "scene.b2p", "-o", "out.ply", "--points"], "out.ply"),
    (
        &[
            "render",
            "scene.b2p",
            "-o",
            "out.png",
            "--size",
            "256x256",
            "--heads",
            "surfels",
        ],
        "out.png",
    ),
    (&["cut", "scene.b2p", "-o", "out.b2p", "--level", "5"], "out.b2p"),
];

fn start(at: &Path, arguments: &[&str]) -> Child {
    Command::new(env!("CARGO_BIN_EXE_b2p"))
        .current_dir(at)
        .env("TMPDIR", at)
        .args(arguments)
        .arg("--force")
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("the program starts")
}

/// What a job writes, and how long that takes.
fn reference(at: &Path, (arguments, output): Job) -> (Vec<u8>, Duration) {
    let began = Instant::now();
    succeeds(at, arguments);
    let took = began.elapsed();
    let whole = std::fs::read(at.join(output)).unwrap();
    std::fs::remove_file(at.join(output)).unwrap();
    (whole, took)
}

/// Sends the signal to a job at one moment after the other. Each time its output is absent, as it was, or whole.
fn signalled(signal: &str, leaves_nothing: bool) {
    let folder = folder();
    let at = folder.path();
    let mut stopped = 0;
    for job in JOBS {
        let (arguments, output) = job;
        let (whole, took) = reference(at, job);
        for moment in 0..10u32 {
            let before = match moment % 2 {
                0 => None,
                _ => Some(b"what was there".to_vec()),
            };
            if let Some(old) = &before {
                std::fs::write(at.join(output), old).unwrap();
            }
            let names = names_in(at);
            let mut child = start(at, arguments);
            std::thread::sleep(took * moment / 9);
            let send = Command::new("kill").args([signal, &child.id().to_string()]).output();
            assert!(send.is_ok(), "kill runs");
            let ended = child.wait().unwrap();
            let found = std::fs::read(at.join(output)).ok();
            assert!(
                found == before || found.as_deref() == Some(&whole[..]),
                "{arguments:?}, {signal} at moment {moment}: an output of {:?} bytes",
                found.map(|bytes| bytes.len())
            );
            stopped += usize::from(!ended.success());
            let _ = std::fs::remove_file(at.join(output));
            if leaves_nothing {
                let inputs: Vec<_> = names.into_iter().filter(|name| name != output).collect();
                assert_eq!(names_in(at), inputs, "{arguments:?}, {signal} at moment {moment}");
            }
        }
        // What was left behind hinders nobody.
        assert!(reference(at, job).0 == whole, "{arguments:?}");
    }
    assert!(stopped >= JOBS.len(), "{stopped} of {} were stopped", 10 * JOBS.len());
}

#[test]
fn a_program_that_is_killed_at_any_moment_leaves_its_output_whole_or_as_it_was() {
    signalled("-KILL", false);
}

#[test]
fn a_program_that_is_killed_while_a_file_grows_leaves_none_that_is_not_whole() {
    let folder = folder();
    let at = folder.path();
    let inputs = names_in(at);
    const DRAW: &[&str] = &[
        "render",
        "scene.b2p",
        "-o",
        "out.exr",
        "--size",
        "900x900",
        "--format",
        "exr",
        "--heads",
        "surfels",
    ];
    let (whole, _) = reference(at, (DRAW, "out.exr"));
    let mut grew = 0;
    for _ in 0..8 {
        let mut child = start(at, DRAW);
        let grows = || {
            let new = names_in(at).into_iter().find(|name| !inputs.contains(name));
            let length = new.and_then(|name| Some(std::fs::metadata(at.join(name)).ok()?.len()));
            length.is_some_and(|length| length > 0 && length < whole.len() as u64)
        };
        while !grows() && child.try_wait().unwrap().is_none() {}
        child.kill().unwrap();
        grew += usize::from(!child.wait().unwrap().success());
        let found = std::fs::read(at.join("out.exr")).ok();
        assert!(
            found.is_none() || found.as_deref() == Some(&whole[..]),
            "a part of a file"
        );
        for name in names_in(at).into_iter().filter(|name| !inputs.contains(name)) {
            std::fs::remove_file(at.join(name)).unwrap();
        }
    }
    assert!(grew > 0, "it was never killed in time");
}

#[test]
fn a_program_that_is_interrupted_at_any_moment_leaves_nothing_half_written_behind() {
    signalled("-INT", true);
}

/// Runs a job whose writes fail once a file has so many kilobytes: `None` if the shell cannot set that.
fn with_files_of(at: &Path, kilobytes: usize, arguments: &[&str]) -> Output {
    let script = format!(
        "trap '' XFSZ; ulimit -f {kilobytes}; exec \"$B2P\" {} --force",
        arguments.join(" ")
    );
    Command::new("bash")
        .current_dir(at)
        .env("B2P", env!("CARGO_BIN_EXE_b2p"))
        .env("TMPDIR", at)
        .args(["-c", &script])
        .output()
        .expect("a shell")
}

#[test]
fn a_file_that_cannot_be_written_to_its_end_is_an_error_and_leaves_what_was_there() {
    let folder = folder();
    let at = folder.path();
    for job in JOBS {
        let (arguments, output) = job;
        let (whole, _) = reference(at, job);
        for old in [None, Some(b"what was there".to_vec())] {
            let last = (whole.len() - 1) / 1024;
            for kilobytes in [0, last / 2, last] {
                match &old {
                    Some(old) => std::fs::write(at.join(output), old).unwrap(),
                    None => drop(std::fs::remove_file(at.join(output))),
                }
                let names = names_in(at);
                let done = with_files_of(at, kilobytes, arguments);
                let errors = String::from_utf8_lossy(&done.stderr);
                let of = format!("{arguments:?} with {kilobytes} kB: {errors}");
                assert_eq!(done.status.code(), Some(1), "{of}");
                assert!(errors.contains("File too large"), "{of}");
                assert_eq!(std::fs::read(at.join(output)).ok(), old, "{of}");
                assert_eq!(names_in(at), names, "{of}");
            }
        }
        let _ = std::fs::remove_file(at.join(output));
    }
}

#[test]
fn a_full_disk_is_an_error_and_leaves_what_was_there() {
    let folder = folder();
    let at = folder.path();
    std::fs::create_dir(at.join("disk")).unwrap();
    for (ran, (arguments, output)) in JOBS.into_iter().enumerate() {
        let to = format!("disk/{output}");
        let arguments: Vec<&str> = arguments
            .iter()
            .map(|word| if *word == output { &to[..] } else { word })
            .collect();
        // The second file takes what the output would need; temporary files of the sort go there, too.
        let script = format!(
            "mount -t tmpfs -o size=64k none disk || exit 99
             echo what was there > {to}; head -c 61440 /dev/zero > disk/other; ls -A disk > before
             TMPDIR=disk \"$B2P\" {} --force; status=$?
             ls -A disk | cmp - before && grep -q 'what was there' {to} || exit 98
             exit $status",
            arguments.join(" ")
        );
        let done = Command::new("unshare")
            .current_dir(at)
            .env("B2P", env!("CARGO_BIN_EXE_b2p"))
            .args(["-m", "bash", "-c", &script])
            .output();
        let Ok(done) = done else {
            eprintln!("skipped: there is no `unshare` here");
            return;
        };
        let errors = String::from_utf8_lossy(&done.stderr);
        if ran == 0 && (done.status.code() == Some(99) || errors.contains("unshare")) {
            eprintln!("skipped: a disk of 64 kB cannot be had here: {errors}");
            return;
        }
        assert_eq!(done.status.code(), Some(1), "{arguments:?}: {errors}");
        assert!(errors.contains("No space left"), "{arguments:?}: {errors}");
    }
}

#[test]
fn an_input_that_is_cut_short_while_it_is_read_is_an_error_or_was_read_before() {
    let folder = folder();
    let at = folder.path();
    let inputs = ["ball.ply", "binary.ply", "ball.b2p", "scene.b2p"];
    let copies: Vec<(&str, Vec<u8>)> = inputs
        .iter()
        .map(|name| (*name, std::fs::read(at.join(name)).unwrap()))
        .collect();
    let mut refused = 0;
    for job in JOBS {
        let (arguments, output) = job;
        let restore = || {
            for (name, bytes) in &copies {
                std::fs::write(at.join(name), bytes).unwrap();
            }
        };
        restore();
        let (whole, took) = reference(at, job);
        for moment in 0..8u32 {
            restore();
            let mut child = start(at, arguments);
            std::thread::sleep(took * moment / 9);
            let input = std::fs::File::options()
                .write(true)
                .open(at.join(arguments[1]))
                .unwrap();
            let length = input.metadata().unwrap().len();
            input.set_len(length / 2 + u64::from(moment)).unwrap();
            let ended = child.wait().unwrap();
            let found = std::fs::read(at.join(output)).ok();
            let of = format!("{arguments:?}, cut at moment {moment}: {ended}");
            match ended.code() {
                Some(0) => {
                    // A cut stream is decoded to its finest whole level, and says so.
                    let is_stream = arguments[1] == "ball.b2p";
                    assert!(is_stream || found.as_deref() == Some(&whole[..]), "{of}");
                }
                // Of a scene, what could be decoded is written.
                Some(1) => {
                    refused += 1;
                    assert!(found.is_none() || arguments[1] == "scene.b2p", "{of}");
                }
                _ => panic!("{of}"),
            }
            let _ = std::fs::remove_file(at.join(output));
        }
    }
    assert!(refused > 0, "no input was cut in time");
}

#[test]
fn a_scene_that_does_not_fit_into_the_machine_is_refused_before_it_is_decoded() {
    let folder = folder();
    let at = folder.path();
    let job = (
        &["decode", "scene.b2p", "-o", "out.ply", "--heads", "surfels"][..],
        "out.ply",
    );
    let (whole, _) = reference(at, job);
    let (mut refused, mut decoded) = (0, 0);
    // From what the program itself takes on, in kilobytes.
    for kilobytes in (20_000..400_000).step_by(1_500) {
        let arguments = "decode scene.b2p -o out.ply --heads surfels --force --threads 1";
        let script = format!("ulimit -v {kilobytes} || exit 99; exec \"$B2P\" {arguments}");
        let done = Command::new("bash")
            .current_dir(at)
            .env("B2P", env!("CARGO_BIN_EXE_b2p"))
            .env("RUST_BACKTRACE", "0")
            .args(["-c", &script])
            .output()
            .expect("a shell");
        if done.status.code() == Some(99) {
            eprintln!("skipped: `ulimit -v` is not permitted here");
            return;
        }
        let errors = String::from_utf8_lossy(&done.stderr);
        let of = format!("{kilobytes} kB: {}, {errors}", done.status);
        assert!(!errors.contains("panicked"), "{of}");
        refused += usize::from(errors.contains("scene.b2p: no memory for decoding"));
        let found = std::fs::read(at.join("out.ply")).ok();
        match done.status.success() {
            true => assert!(found.as_deref() == Some(&whole[..]), "{of}"),
            false => assert_eq!(found, None, "{of}"),
        }
        let _ = std::fs::remove_file(at.join("out.ply"));
        decoded += usize::from(done.status.success());
        if decoded == 3 {
            break;
        }
    }
    assert!(refused > 0 && decoded > 0, "{refused} refused, {decoded} decoded");
}
