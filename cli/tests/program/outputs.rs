//! Where results and reports go, and what is overwritten.

use super::*;

#[cfg(unix)]
#[test]
fn an_output_that_is_a_fifo_or_a_link_stays_what_it_is() {
    use std::os::unix::fs::{FileTypeExt, symlink};
    let folder = folder_with_stream();
    let at = folder.path();
    let decode = |to: &str| succeeds(at, &["decode", "ball.b2p", "-o", to]);
    decode("file.ply");
    let expected = std::fs::read(at.join("file.ply")).unwrap();
    symlink("behind.ply", at.join("link.ply")).unwrap();
    decode("link.ply");
    assert!(at.join("link.ply").is_symlink());
    assert_eq!(std::fs::read(at.join("behind.ply")).unwrap(), expected);

    let fifo = at.join("fifo.ply");
    let made = std::process::Command::new("mkfifo").arg(&fifo).status();
    if made.is_ok_and(|status| status.success()) {
        let reader = std::thread::spawn({
            let fifo = fifo.clone();
            move || std::fs::read(fifo).unwrap()
        });
        decode("fifo.ply");
        assert_eq!(reader.join().unwrap(), expected);
        assert!(std::fs::symlink_metadata(&fifo).unwrap().file_type().is_fifo());
    }
}

#[cfg(target_os = "linux")]
#[test]
fn a_file_is_made_under_a_name_of_its_own_and_synchronised_before_it_gets_the_one_asked_for() {
    let folder = folder_with_stream();
    let at = folder.path();
    let calls = "trace=openat,fsync,rename,renameat,renameat2";
    let traced = Command::new("strace")
        .current_dir(at)
        .args(["-f", "-o", "calls.txt", "-e", calls, env!("CARGO_BIN_EXE_b2p")])
        .args(["decode", "ball.b2p", "out.ply", "--heads", "surfels"])
        .output();
    if !traced.is_ok_and(|done| done.status.success()) {
        eprintln!("skipped: strace cannot be had");
        return;
    }
    let text = std::fs::read_to_string(at.join("calls.txt")).unwrap();
    let calls: Vec<&str> = text.lines().collect();
    let place = |words: &[&str]| {
        calls
            .iter()
            .position(|call| words.iter().all(|word| call.contains(word)))
    };
    let made = place(&["openat", ".b2p-", "O_EXCL"]);
    let places = [made, place(&["fsync("]), place(&["rename", ".b2p-", "out.ply"])];
    assert!(
        places.iter().all(Option::is_some) && places.is_sorted(),
        "{places:?}: {text}"
    );
}

#[test]
fn an_existing_file_is_overwritten_only_if_that_is_asked_for() {
    let folder = folder_with_stream();
    let at = folder.path();
    let commands: [&[&str]; 4] = [
        &["encode", "ball.ply", "there"],
        &["decode", "ball.b2p", "there"],
        &["render", "ball.b2p", "there", "--size", "8x8"],
        &["cut", "ball.b2p", "there", "--level", "5"],
    ];
    for command in commands {
        std::fs::write(at.join("there"), b"old").unwrap();
        let refused = plain(at, command);
        assert_eq!(refused.status.code(), Some(1), "{command:?}");
        let errors = String::from_utf8_lossy(&refused.stderr);
        assert!(
            errors.contains("there exists already") && errors.contains("--force"),
            "{errors}"
        );
        assert_eq!(std::fs::read(at.join("there")).unwrap(), b"old");
        let forced = plain(at, &[command, &["-f"]].concat());
        assert!(forced.status.success(), "{command:?}");
        assert_ne!(std::fs::read(at.join("there")).unwrap(), b"old");
    }
    let turn = ["render", "ball.b2p", "turn.png", "--size", "8x8", "--views", "3"];
    std::fs::write(at.join("turn-001.png"), b"old").unwrap();
    let refused = plain(at, &turn);
    assert!(String::from_utf8_lossy(&refused.stderr).contains("turn-001.png exists"));
    assert!(!at.join("turn-000.png").exists());
}

#[test]
fn an_input_is_never_its_own_output_not_even_by_force() {
    let folder = folder_with_stream();
    let at = folder.path();
    let before = [std::fs::read(at.join("ball.ply")), std::fs::read(at.join("ball.b2p"))].map(Result::unwrap);
    let same: [&[&str]; 4] = [
        &["encode", "ball.ply", "-o", "./ball.ply"],
        &["decode", "ball.b2p", "-o", "ball.b2p"],
        &["render", "ball.b2p", "-o", "ball.b2p", "--format", "png"],
        &["cut", "ball.b2p", "ball.b2p", "--level", "5"],
    ];
    for command in same {
        fails(at, command, &["is the input"]);
    }
    #[cfg(unix)]
    {
        std::os::unix::fs::symlink("ball.ply", at.join("link.ply")).unwrap();
        fails(at, &["encode", "ball.ply", "link.ply"], &["is the input"]);
        std::fs::hard_link(at.join("ball.ply"), at.join("hard.ply")).unwrap();
        fails(at, &["encode", "hard.ply", "ball.ply"], &["is the input"]);
    }
    let camera = [
        "render",
        "ball.b2p",
        "cameras.json",
        "--format",
        "png",
        "--camera",
        "cameras.json",
    ];
    std::fs::write(
        at.join("cameras.json"),
        r#"{"fl_x": 9, "frames": [{"transform_matrix": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}"#,
    )
    .unwrap();
    fails(at, &camera, &["cameras.json is the input"]);
    let after = [std::fs::read(at.join("ball.ply")), std::fs::read(at.join("ball.b2p"))].map(Result::unwrap);
    assert!(before == after);
}

#[test]
fn a_dash_is_standard_input_and_output_for_every_command() {
    let folder = folder_with_stream();
    let at = folder.path();
    let [cloud, stream] = ["ball.ply", "ball.b2p"].map(|name| std::fs::read(at.join(name)).unwrap());
    let fed = |arguments: &[&str], input: &[u8]| {
        let done = piped(at, arguments, input);
        let errors = String::from_utf8_lossy(&done.stderr);
        assert!(done.status.success(), "{arguments:?}: {errors}");
        done.stdout
    };
    assert_eq!(fed(&["encode", "-", "-", "--bits", "7"], &cloud), stream);
    assert_eq!(
        fed(&["encode", "-", "-o", "-", "--bits", "7", "--json"], &cloud),
        stream
    );
    succeeds(at, &["decode", "ball.b2p", "g.ply"]);
    succeeds(at, &["decode", "ball.b2p", "p.ply", "--points"]);
    succeeds(at, &["cut", "ball.b2p", "c.b2p", "--level", "5"]);
    let file = |name: &str| std::fs::read(at.join(name)).unwrap();
    assert_eq!(fed(&["decode", "-", "-"], &stream), file("g.ply"));
    assert_eq!(fed(&["decode", "-", "-o", "-", "--points"], &stream), file("p.ply"));
    assert_eq!(fed(&["cut", "-", "-", "--level", "5"], &stream), file("c.b2p"));
    assert!(fed(&["info", "-"], &stream).starts_with(b"version 3"));
    assert!(fed(&["render", "-", "-", "--size", "8x8"], &stream).starts_with(b"\x89PNG"));
    assert!(!at.join("-").exists());
}

#[test]
fn results_go_to_standard_output_and_reports_to_standard_error() {
    let folder = folder_with_stream();
    let at = folder.path();
    let reporting: [&[&str]; 4] = [
        &["encode", "ball.ply", "x.b2p"],
        &["decode", "ball.b2p", "x.ply"],
        &["render", "ball.b2p", "x.png", "--size", "8x8"],
        &["cut", "ball.b2p", "y.b2p", "--level", "5"],
    ];
    for command in reporting {
        let done = b2p(at, command);
        assert!(done.status.success() && done.stdout.is_empty(), "{command:?}");
        assert!(!done.stderr.is_empty(), "{command:?}");
        let quiet = b2p(at, &[command, &["-q"]].concat());
        assert!(quiet.stdout.is_empty() && quiet.stderr.is_empty(), "{command:?}");
        let json = b2p(at, &[command, &["--json"]].concat());
        let value: Value = serde_json::from_slice(&json.stdout).expect("JSON");
        assert!(value.is_object() || value.is_array());
        assert!(
            json.stderr.is_empty(),
            "{command:?}: {}",
            String::from_utf8_lossy(&json.stderr)
        );
    }
    let info = b2p(at, &["info", "ball.b2p", "-q"]);
    assert!(
        !info.stdout.is_empty() && info.stderr.is_empty(),
        "a result is no report"
    );
}

#[test]
fn numbers_agree_with_their_nouns() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    std::fs::write(at.join("one.ply"), sparse_ball(1)).unwrap();
    let said = succeeds(at, &["encode", "one.ply", "one.b2p", "--bits", "3"]);
    assert!(said.contains("for 1 point at 3 bits"), "{said}");
    let info = succeeds(at, &["info", "one.b2p"]);
    assert!(info.contains("1 point at 3 bits"), "{info}");
    let said = succeeds(at, &["decode", "one.b2p", "p.ply", "--points"]);
    assert!(said.contains("p.ply: 1 point\n"), "{said}");
}

#[test]
fn messages_are_coloured_only_if_asked_for_where_nobody_watches() {
    let folder = tempfile::tempdir().unwrap();
    let said = |colour: &[&str]| {
        let done = plain(folder.path(), &[&["info", "absent.b2p"], colour].concat());
        assert_eq!(done.status.code(), Some(1));
        String::from_utf8(done.stderr).unwrap()
    };
    assert!(said(&[]).starts_with("b2p: absent.b2p"));
    assert!(said(&["--color", "never"]).starts_with("b2p: "));
    assert!(said(&["--color=always"]).starts_with("\x1b[1;31mb2p:\x1b[0m "));
    let help = plain(folder.path(), &["--color", "always", "encode", "--help"]);
    assert!(String::from_utf8(help.stdout).unwrap().contains("\x1b["));
}

#[test]
fn help_shows_few_options_before_the_advanced_ones() {
    let folder = tempfile::tempdir().unwrap();
    let help = succeeds(folder.path(), &["encode", "--help"]);
    let (first, advanced) = help.split_once("Advanced:").expect("a heading");
    for option in ["--quality", "--effort", "--bits-per-point", "--output"] {
        assert!(first.contains(option), "{option}");
    }
    for option in ["--step", "--levels", "--bits <", "--no-filter", "--isa"] {
        assert!(advanced.contains(option) && !first.contains(option), "{option}");
    }
}

#[cfg(target_os = "linux")]
mod standard_output {
    use super::*;

    /// Runs the program in a shell, after which more may follow.
    fn shell(at: &Path, script: &str) -> Output {
        Command::new("sh")
            .current_dir(at)
            .env("B2P", env!("CARGO_BIN_EXE_b2p"))
            .args(["-c", script])
            .output()
            .expect("a shell")
    }

    #[test]
    fn a_full_device_is_an_error() {
        let folder = folder_with_stream();
        for command in ["info ball.b2p", "render ball.b2p - --size 8x8", "decode ball.b2p -"] {
            let done = shell(folder.path(), &format!("\"$B2P\" {command} > /dev/full"));
            let errors = String::from_utf8_lossy(&done.stderr);
            assert_eq!(done.status.code(), Some(1), "{command}: {errors}");
            assert!(errors.contains("No space left"), "{command}: {errors}");
        }
    }

    #[test]
    fn a_reader_that_has_gone_ends_the_program_quietly_but_not_with_0() {
        let folder = folder_with_stream();
        for command in ["info ball.b2p", "render ball.b2p - --size 700x700", "decode ball.b2p -"] {
            let script = format!("(sleep 0.3; \"$B2P\" {command} -q; echo $? >&2) | true");
            let done = shell(folder.path(), &script);
            assert_eq!(String::from_utf8_lossy(&done.stderr).trim(), "141", "{command}");
        }
    }

    #[test]
    fn a_closed_standard_output_is_an_error_where_there_is_something_to_write() {
        let folder = folder_with_stream();
        for command in ["info ball.b2p", "decode ball.b2p -"] {
            let done = shell(folder.path(), &format!("\"$B2P\" {command} >&-"));
            let errors = String::from_utf8_lossy(&done.stderr);
            assert_eq!(done.status.code(), Some(1), "{command}: {errors}");
            assert!(errors.contains("standard output is closed"), "{command}: {errors}");
        }
        let silent = shell(folder.path(), "\"$B2P\" decode ball.b2p x.ply -q >&-");
        assert!(silent.status.success());
        let ignored = shell(
            folder.path(),
            "\"$B2P\" info ball.b2p > /dev/null; \"$B2P\" info ball.b2p <> /dev/null >&0",
        );
        assert!(ignored.status.success(), "a null device is not closed");
    }
}

#[cfg(target_os = "linux")]
#[test]
fn on_a_terminal_the_program_asks_before_it_overwrites() {
    let folder = folder_with_stream();
    let at = folder.path();
    let answer = |answer: &str| {
        std::fs::write(at.join("there.ply"), b"old").unwrap();
        // `script` gives the program a terminal, and this pipe what is typed.
        let command = format!("'{}' decode ball.b2p there.ply", env!("CARGO_BIN_EXE_b2p"));
        let started = Command::new("script")
            .current_dir(at)
            .args(["-qec", &command, "/dev/null"])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn();
        let Ok(mut child) = started else {
            eprintln!("skipped: `script` is not installed");
            return None;
        };
        let mut typed = child.stdin.take().expect("a pipe");
        typed.write_all(answer.as_bytes()).unwrap();
        let done = child.wait_with_output().unwrap();
        drop(typed);
        let said = String::from_utf8_lossy(&done.stdout).into_owned();
        assert!(said.contains("there.ply exists already; overwrite? [y/N]"), "{said}");
        let replaced = std::fs::read(at.join("there.ply")).unwrap() != b"old";
        assert_eq!(done.status.success(), replaced, "{said}");
        Some(replaced)
    };
    if let Some(replaced) = answer("y\n") {
        assert!(replaced);
        assert_eq!(answer("n\n"), Some(false));
        assert_eq!(answer("\n"), Some(false));
    }
}

/// Of eight Gaussians of a voxel it is known in the end how many there are.
#[test]
fn gaussians_that_are_written_as_they_are_made_give_the_file_of_all_at_once() {
    let folder = folder_with_stream();
    let at = folder.path();
    let heads = b2p::HeadsModel::from_bytes(b2p::embedded::HEADS).unwrap();
    let stream = std::fs::read(at.join("ball.b2p")).unwrap();
    for (name, count) in [("surfels", 1), ("surfels", 4), ("quick", 1), ("quick", 8)] {
        let decoder = b2p::Decoder::new()
            .with_heads_model(heads.clone())
            .with_heads(name.parse().unwrap())
            .with_per_voxel(count);
        let mut expected = Vec::new();
        let gaussians = decoder.decode(&stream).unwrap();
        gaussians.write_ply(&mut expected, Path::new("x")).unwrap();
        let count = count.to_string();
        let how = ["--heads", name, "--per-voxel", &count];
        let decode = |to| b2p(at, &[&["decode", "ball.b2p", "-o", to][..], &how].concat());
        assert!(decode("out.ply").status.success());
        assert!(
            std::fs::read(at.join("out.ply")).unwrap() == expected,
            "{name}, {count}"
        );
        assert!(decode("-").stdout == expected, "{name}, {count} to standard output");
    }
    let left = names_in(at)
        .into_iter()
        .filter(|name| name.to_string_lossy().starts_with(".b2p"));
    assert_eq!(left.count(), 0, "temporary files are left");
}
