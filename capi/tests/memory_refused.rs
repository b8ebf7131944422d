//! Memory that the system refuses, at any call of the allocator: an error, or the end of the process by an abort, which
//! is what Rust does where a vector cannot grow. Nothing unwinds, nothing hangs, and files stay as they were.
//!
//! It is a test of the library. It stands here because an allocator takes `unsafe`.

use std::alloc::{GlobalAlloc, Layout, System};
use std::path::Path;
use std::process::{Command, ExitStatus};
use std::sync::atomic::{AtomicUsize, Ordering};

use b2p::renderer::camera::Camera;
use b2p::{Decoder, Error, Limits, Renderer, SceneDecoder, SceneReader, Wanted, input, output};

/// Calls that are counted have at least so many bytes.
static LEAST: AtomicUsize = AtomicUsize::new(usize::MAX);
static CALLS: AtomicUsize = AtomicUsize::new(0);
/// The call that fails.
static FAILS: AtomicUsize = AtomicUsize::new(usize::MAX);

struct Failing;

#[global_allocator]
static ALLOCATOR: Failing = Failing;

fn is_refused(size: usize) -> bool {
    size >= LEAST.load(Ordering::Relaxed) && CALLS.fetch_add(1, Ordering::Relaxed) + 1 == FAILS.load(Ordering::Relaxed)
}

// SAFETY: what is not refused is the system's; NULL says that there is no memory.
unsafe impl GlobalAlloc for Failing {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        match is_refused(layout.size()) {
            true => std::ptr::null_mut(),
            // SAFETY: the caller vouches for the layout.
            false => unsafe { System.alloc(layout) },
        }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        match is_refused(layout.size()) {
            true => std::ptr::null_mut(),
            // SAFETY: the caller vouches for the layout.
            false => unsafe { System.alloc_zeroed(layout) },
        }
    }

    unsafe fn realloc(&self, at: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        match is_refused(size) {
            true => std::ptr::null_mut(),
            // SAFETY: the caller vouches for the block.
            false => unsafe { System.realloc(at, layout, size) },
        }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        // SAFETY: the caller vouches for the block.
        unsafe { System.dealloc(at, layout) }
    }
}

/// Exit codes of the process that has no memory.
const OUT_OF_MEMORY: i32 = 3;
const OTHER_ERROR: i32 = 4;

/// The arguments of that process.
const ARGUMENTS: &str = "B2P_MEMORY_REFUSED";

fn root() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
}

/// Reads a stream or a scene from a file, draws it, and writes the picture.
fn draw(input: &Path, to: &Path) -> b2p::Result<()> {
    let bytes = input::read_file(input, &Limits::default())?;
    let gaussians = match SceneReader::is_scene(&bytes) {
        true => {
            let scene = SceneReader::new(&bytes[..], &Limits::default())?;
            SceneDecoder::default().gaussians(&scene, &Wanted::All)?.whole()?
        }
        false => Decoder::new().decode(&bytes)?,
    };
    let camera = Camera::orbit(20.0, 10.0, 3.0, 45.0, 200, 150)?;
    let picture = Renderer::new().render(&gaussians, &camera)?;
    output::write_file(to, |writer| picture.write_png(writer, to))
}

/// What runs in a process of its own, which it may end.
#[test]
fn child() {
    let Ok(arguments) = std::env::var(ARGUMENTS) else {
        return;
    };
    let words: Vec<&str> = arguments.split(' ').collect();
    let (input, to) = (root().join(words[0]), Path::new(words[1]));
    let [least, fails] = [words[2], words[3]].map(|number| number.parse::<usize>().unwrap());
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let drawn = pool.install(|| {
        FAILS.store(fails, Ordering::Relaxed);
        LEAST.store(least, Ordering::Relaxed);
        let drawn = draw(&input, to);
        LEAST.store(usize::MAX, Ordering::Relaxed);
        drawn
    });
    println!("calls {}", CALLS.load(Ordering::Relaxed));
    match drawn {
        Ok(()) => {}
        Err(Error::OutOfMemory { .. }) => std::process::exit(OUT_OF_MEMORY),
        Err(error) => {
            println!("{error}");
            std::process::exit(OTHER_ERROR);
        }
    }
}

/// Draws in a process whose n-th call of the allocator for at least so many bytes fails: how it ended, and how many
/// calls there were.
fn run(input: &str, to: &Path, least: usize, fails: usize) -> (ExitStatus, usize) {
    let program = std::env::current_exe().expect("a path");
    let output = Command::new(program)
        .args(["--exact", "child", "--nocapture", "--test-threads=1"])
        .env(ARGUMENTS, format!("{input} {} {least} {fails}", to.display()))
        .env("RUST_BACKTRACE", "0")
        .output()
        .expect("the process starts");
    let printed = String::from_utf8_lossy(&output.stdout);
    let calls = printed
        .split("calls ")
        .nth(1)
        .and_then(|rest| rest.split_whitespace().next());
    let calls = calls.and_then(|calls| calls.parse().ok()).unwrap_or(0);
    (output.status, calls)
}

fn was_aborted(status: ExitStatus) -> bool {
    #[cfg(unix)]
    return std::os::unix::process::ExitStatusExt::signal(&status) == Some(6);
    #[cfg(not(unix))]
    return !status.success() && status.code() != Some(101);
}

const INPUTS: [&str; 2] = ["models/scene.b2p", "tests/data/conformance/scenes/ball.b2p"];

#[test]
fn memory_that_is_refused_at_any_call_is_an_error_or_an_abort_and_files_stay_as_they_were() {
    let folder = tempfile::tempdir().expect("a folder");
    let to = folder.path().join("picture.png");
    for input in INPUTS {
        for least in [0, 1 << 16] {
            let (status, calls) = run(input, &to, least, usize::MAX);
            assert!(status.success() && calls > 3, "{input}: {status}, {calls} calls");
            let whole = std::fs::read(&to).expect("a picture");
            std::fs::write(&to, b"old").expect("written");
            let (mut errors, mut aborts) = (0, 0);
            for fails in (1..=calls).step_by((calls / 25).max(1)) {
                let (status, _) = run(input, &to, least, fails);
                let found = std::fs::read(&to).expect("a file");
                let of = format!("{input}, call {fails} of {calls} for at least {least} bytes: {status}");
                match status.code() {
                    Some(0) => assert!(found == whole, "{of}"),
                    Some(OUT_OF_MEMORY) => errors += 1,
                    _ => {
                        assert!(was_aborted(status), "{of}");
                        aborts += 1;
                    }
                }
                assert!(status.success() || found == b"old", "{of}");
                let names = std::fs::read_dir(folder.path()).expect("a folder").count();
                assert!(was_aborted(status) || names == 1, "{of}: {names} files");
                for name in std::fs::read_dir(folder.path()).expect("a folder") {
                    let path = name.expect("a name").path();
                    if path != to {
                        // The temporary file of a process that has ended within its last write.
                        std::fs::remove_file(path).expect("removed");
                    }
                }
                std::fs::write(&to, b"old").expect("written");
            }
            println!("{input}, at least {least} bytes: {calls} calls, {errors} errors, {aborts} aborts");
            assert!(errors + aborts > 0, "{input}: nothing was refused");
            assert!(
                least == 0 || errors > 0,
                "{input}: no large block is asked for in a way that can fail"
            );
        }
    }
}
