//! Inputs without an end, limits, and machines that have too little of something.

use super::*;

/// Runs the program with a standard input that never ends.
#[cfg(unix)]
fn endless(at: &Path, start: &str, arguments: &str) -> Output {
    let script = format!("({start}; exec cat /dev/zero) | \"$B2P\" {arguments}");
    Command::new("bash")
        .current_dir(at)
        .env("B2P", env!("CARGO_BIN_EXE_b2p"))
        .args(["-c", &script])
        .output()
        .expect("a shell")
}

#[cfg(unix)]
#[test]
fn an_input_without_an_end_is_refused_at_the_limit() {
    let folder = folder_with_stream();
    let at = folder.path();
    let few = "--max-memory 3M";
    for (start, arguments) in [
        ("printf 'ply\\ncomment x\\n'", format!("decode - x.ply {few}")),
        ("printf 'ply\\ncomment x\\n'", format!("render - x.png {few}")),
        ("printf 'ply\\ncomment x\\n'", format!("encode - x.b2p {few}")),
        ("true", format!("encode - x.b2p {few}")),
        ("true", format!("info - {few}")),
        ("true", format!("render /dev/zero x.png {few}")),
        ("true", format!("decode /dev/zero x.ply {few}")),
        ("true", format!("encode /dev/zero x.b2p {few}")),
        ("true", format!("info /dev/zero {few}")),
    ] {
        let done = endless(at, start, &arguments);
        let errors = String::from_utf8_lossy(&done.stderr);
        assert_eq!(done.status.code(), Some(1), "{arguments}: {errors}");
        assert!(
            errors.contains("limit of 3145728") && errors.contains("--max-memory"),
            "{arguments}: {errors}"
        );
    }
    // What follows a stream is not read for ever.
    let done = endless(at, "cat ball.b2p", "decode - x.ply");
    let errors = String::from_utf8_lossy(&done.stderr);
    assert_eq!(done.status.code(), Some(1), "{errors}");
    assert!(errors.contains("after the last section"), "{errors}");
    assert!(!at.join("x.ply").exists());
}

#[test]
fn a_file_over_the_limit_is_refused_before_it_is_read() {
    let folder = folder_with_stream();
    let at = folder.path();
    let file = std::fs::File::create(at.join("large.ply")).unwrap();
    // A hole takes no room.
    file.set_len(1 << 40).unwrap();
    for (command, to) in [
        ("decode", &["-o", "x.ply"] as &[&str]),
        ("render", &["-o", "x.png"]),
        ("encode", &["-o", "x.b2p"]),
        ("info", &[]),
    ] {
        let words = ["large.ply", "size of the file is 1099511627776", "--max-memory"];
        fails(at, &[&[command, "large.ply"], to].concat(), &words);
    }
}

#[test]
fn the_memory_limit_holds_for_the_files_of_pictures_too() {
    let folder = folder_with_stream();
    let at = folder.path();
    let draw = |more: &[&str]| {
        b2p(
            at,
            &[&["render", "ball.b2p", "big.png", "--size", "1500x1500"], more].concat(),
        )
    };
    // 36 MB of pixels, and 9 MB of distances in OpenEXR.
    assert!(draw(&["--max-memory", "42M"]).status.success());
    let exr = draw(&["--max-memory", "42M", "--format", "exr"]);
    let errors = String::from_utf8_lossy(&exr.stderr);
    assert!(
        exr.status.code() == Some(1) && errors.contains("--max-memory"),
        "{errors}"
    );
    assert!(draw(&["--max-memory", "52M", "--format", "exr"]).status.success());
    let ids = draw(&["--max-memory", "42M", "--show", "id"]);
    assert_eq!(ids.status.code(), Some(1));
}

#[test]
fn work_over_the_limit_is_refused_before_it_is_drawn() {
    let folder = folder_with_stream();
    let at = folder.path();
    let draw = ["render", "ball.b2p", "x.png", "--max-pairs", "10"];
    fails(
        at,
        &draw,
        &["pairs of Gaussians and tiles", "limit of 10", "--max-pairs"],
    );
}

#[test]
fn a_place_beyond_single_precision_is_refused_when_gaussians_are_written() {
    let folder = folder_with_stream();
    let at = folder.path();
    let mut stream = std::fs::read(at.join("ball.b2p")).unwrap();
    stream[32..40].copy_from_slice(&1e300f64.to_le_bytes());
    let levels = usize::from(stream[22] - stream[21]) + 1;
    let end = 72 + 12 * levels;
    let sum = crc32c::crc32c(&stream[..end]);
    stream[end..end + 4].copy_from_slice(&sum.to_le_bytes());
    std::fs::write(at.join("far.b2p"), &stream).unwrap();
    fails(at, &["decode", "far.b2p", "x.ply"], &["1e300", "single precision"]);
    succeeds(at, &["render", "far.b2p", "x.png", "--size", "16x16"]);
}

#[test]
fn so_many_threads_are_refused() {
    let folder = folder_with_stream();
    let done = b2p(folder.path(), &["info", "ball.b2p", "--threads", "65535"]);
    assert_eq!(done.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&done.stderr).contains("1024"));
}

/// Runs the program under limits of the shell; `None`, with a word, if they cannot be set.
#[cfg(target_os = "linux")]
fn limited(at: &Path, limit: &str, arguments: &str) -> Option<Output> {
    let done = Command::new("bash")
        .current_dir(at)
        .env("B2P", env!("CARGO_BIN_EXE_b2p"))
        .args(["-c", &format!("{limit} || exit 99; exec \"$B2P\" {arguments}")])
        .output()
        .expect("a shell");
    if done.status.code() == Some(99) {
        eprintln!("skipped: `{limit}` is not permitted here");
        return None;
    }
    Some(done)
}

#[cfg(target_os = "linux")]
#[test]
fn too_little_memory_is_an_error_and_no_abort() {
    let folder = folder_with_stream();
    let at = folder.path();
    for (arguments, words) in [
        ("render ball.b2p x.png --size 6000x6000 --threads 2", "no memory for"),
        (
            "render /dev/zero x.png --threads 2 --max-memory 3G",
            "no memory for the input",
        ),
    ] {
        let Some(done) = limited(at, "ulimit -v 400000", arguments) else {
            return;
        };
        let errors = String::from_utf8_lossy(&done.stderr);
        assert_eq!(done.status.code(), Some(1), "{arguments}: {errors}");
        assert!(errors.contains(words), "{arguments}: {errors}");
    }
}

#[cfg(target_os = "linux")]
#[test]
fn threads_that_the_system_refuses_are_done_without_or_named() {
    let folder = folder_with_stream();
    let at = folder.path();
    // The limit does not hold for root; another user must be able to reach the program.
    let program = at.join("b2p");
    std::fs::copy(env!("CARGO_BIN_EXE_b2p"), &program).unwrap();
    let allowed = [
        "chmod a+rwx . b2p ball.b2p",
        "setpriv --reuid=65534 --clear-groups true",
    ];
    for command in allowed {
        let done = Command::new("sh")
            .current_dir(at)
            .args(["-c", command])
            .output()
            .expect("a shell");
        if !done.status.success() {
            eprintln!("skipped: `{command}` is not permitted here");
            return;
        }
    }
    let run = |arguments: &str| {
        let script = format!("ulimit -u 1; exec ./b2p {arguments}");
        let script = ["--reuid=65534", "--clear-groups", "bash", "-c", &script];
        Command::new("setpriv")
            .current_dir(at)
            .args(script)
            .output()
            .expect("setpriv runs")
    };
    let done = run("decode ball.b2p few.ply");
    let errors = String::from_utf8_lossy(&done.stderr);
    assert!(
        done.status.success() && errors.contains("works in 1 thread of "),
        "{errors}"
    );
    succeeds(at, &["decode", "ball.b2p", "many.ply"]);
    let [few, many] = ["few.ply", "many.ply"].map(|name| std::fs::read(at.join(name)).unwrap());
    assert!(few == many);
    let named = run("decode ball.b2p x.ply --threads 4");
    let errors = String::from_utf8_lossy(&named.stderr);
    assert_eq!(named.status.code(), Some(1), "{errors}");
    assert!(errors.contains("cannot start 4 threads"), "{errors}");
}

#[cfg(unix)]
#[test]
fn a_model_file_is_read_whatever_it_is_not_mapped() {
    let folder = folder_with_cloud();
    let at = folder.path();
    std::fs::write(at.join("tiny.safetensors"), tiny_model(1)).unwrap();
    let encode = [
        "encode",
        "ball.ply",
        "l.b2p",
        "--colours",
        "learned",
        "--model",
        "tiny.safetensors",
    ];
    succeeds(at, &encode);
    let fifo = Command::new("bash")
        .current_dir(at)
        .env("B2P", env!("CARGO_BIN_EXE_b2p"))
        .args(["-c", "\"$B2P\" decode l.b2p x.ply --model <(cat tiny.safetensors)"])
        .output()
        .expect("a shell");
    let errors = String::from_utf8_lossy(&fifo.stderr);
    assert!(fifo.status.success(), "a FIFO cannot be mapped: {errors}");
}

#[test]
fn a_stream_that_learned_heads_do_not_draw_is_not_written_without_a_word() {
    let folder = folder_with_cloud();
    let encode = ["encode", "ball.ply", "x.b2p", "--levels", "0..0"];
    let done = b2p(folder.path(), &encode);
    let said = String::from_utf8_lossy(&done.stderr);
    assert!(done.status.success() && said.contains("--heads surfels"), "{said}");
}
