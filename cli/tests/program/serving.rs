//! `b2p serve` from outside: what it gives, and what it refuses. Skipped where the page is not built.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};

const SCENE: &[u8] = include_bytes!("../../../models/scene.b2p");

/// A server, until it is dropped.
pub struct Serving {
    child: Child,
    address: String,
}

impl Serving {
    /// Of `source` in `folder`, if the program has its page.
    fn start(folder: &Path, source: &str) -> Option<Serving> {
        Self::start_with(folder, source, &[])
    }

    /// The same with these variables.
    pub fn start_with(folder: &Path, source: &str, environment: &[(&str, &str)]) -> Option<Serving> {
        let mut child = Command::new(env!("CARGO_BIN_EXE_b2p"))
            .current_dir(folder)
            .envs(environment.iter().copied())
            .args(["serve", source, "--port", "0"])
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the program starts");
        let mut line = String::new();
        let out = child.stdout.take().expect("a pipe");
        BufReader::new(out).read_line(&mut line).expect("a line");
        if line.is_empty() {
            let mut errors = String::new();
            let stderr = child.stderr.as_mut().expect("a pipe");
            stderr.read_to_string(&mut errors).expect("text");
            child.wait().expect("it ends");
            assert!(errors.contains("without its web page"), "{errors}");
            println!("skipped: the page is not built (web/build.sh)");
            return None;
        }
        let (_, rest) = line.split_once("http://").expect("an address");
        let (address, _) = rest.split_once('/').expect("an address");
        Some(Serving {
            child,
            address: address.to_owned(),
        })
    }

    /// What comes back for a request: the head in lower case, and the body.
    pub fn ask(&self, request: &str) -> (String, Vec<u8>) {
        let mut stream = TcpStream::connect(&self.address).expect("a connection");
        write!(stream, "{request}\r\nHost: localhost\r\nConnection: close\r\n\r\n").expect("a request");
        let mut bytes = Vec::new();
        stream.read_to_end(&mut bytes).expect("an answer");
        let end = bytes.windows(4).position(|four| four == b"\r\n\r\n").expect("a head");
        let head = String::from_utf8_lossy(&bytes[..end]).to_lowercase();
        (head, bytes[end + 4..].to_vec())
    }

    #[track_caller]
    fn status(&self, request: &str) -> u16 {
        let (head, _) = self.ask(request);
        head.split(' ')
            .nth(1)
            .and_then(|status| status.parse().ok())
            .expect("a status")
    }
}

impl Drop for Serving {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn a_folder_is_served_with_its_page_whole_and_in_ranges() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("a scene.b2p"), SCENE).unwrap();
    let Some(serving) = Serving::start(folder.path(), ".") else {
        return;
    };
    let (head, page) = serving.ask("GET / HTTP/1.1");
    assert!(head.contains("200") && head.contains("text/html") && String::from_utf8_lossy(&page).contains("<canvas>"));
    assert!(head.contains("cross-origin-opener-policy: same-origin"));
    assert!(head.contains("cross-origin-embedder-policy: require-corp"));
    let (head, module) = serving.ask("GET /b2p.wasm HTTP/1.1");
    assert!(head.contains("application/wasm") && head.contains("content-encoding: gzip"));
    assert_eq!(module[..2], [0x1f, 0x8b]);
    let (head, threads) = serving.ask("GET /b2p-threads.wasm HTTP/1.1");
    match b2p_web::module_gzip("b2p-threads.wasm") {
        Some(_) => assert!(head.contains("application/wasm") && threads[..2] == [0x1f, 0x8b]),
        None => assert!(head.contains("404")),
    }
    let (_, list) = serving.ask("GET /streams.json HTTP/1.1");
    let list: serde_json::Value = serde_json::from_slice(&list).unwrap();
    assert_eq!(list["streams"], serde_json::json!(["a scene.b2p"]));
    let (head, stream) = serving.ask("GET /a%20scene.b2p HTTP/1.1");
    assert!(head.contains("200") && head.contains("accept-ranges: bytes") && stream == SCENE);
    let (head, part) = serving.ask("GET /a%20scene.b2p HTTP/1.1\r\nRange: bytes=100-299");
    assert!(head.contains("206") && head.contains(&format!("bytes 100-299/{}", SCENE.len())));
    assert_eq!(part, SCENE[100..300]);
    let (head, nothing) = serving.ask("HEAD /a%20scene.b2p HTTP/1.1");
    assert!(head.contains("200") && nothing.is_empty());
    assert_eq!(
        serving.status("GET /a%20scene.b2p HTTP/1.1\r\nRange: bytes=99999999-"),
        416
    );
}

#[test]
fn files_of_gaussians_are_served_too() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("scene.b2p"), SCENE).unwrap();
    for name in ["scene.ply", "scene.spz", "scene.splat"] {
        super::succeeds(
            folder.path(),
            &["decode", "scene.b2p", name, "--level", "7", "--heads", "surfels"],
        );
    }
    let Some(serving) = Serving::start(folder.path(), ".") else {
        return;
    };
    let (_, list) = serving.ask("GET /streams.json HTTP/1.1");
    let list: serde_json::Value = serde_json::from_slice(&list).unwrap();
    let names = ["scene.b2p", "scene.ply", "scene.splat", "scene.spz"];
    assert_eq!(list["streams"], serde_json::json!(names));
    let (head, file) = serving.ask("GET /scene.spz HTTP/1.1");
    assert!(head.contains("200") && file == std::fs::read(folder.path().join("scene.spz")).unwrap());
}

#[test]
fn nothing_else_of_the_folder_and_nothing_outside_is_served() {
    let folder = tempfile::tempdir().unwrap();
    let inside = folder.path().join("inside");
    std::fs::create_dir_all(inside.join("deeper")).unwrap();
    std::fs::write(inside.join("scene.b2p"), SCENE).unwrap();
    std::fs::write(inside.join("secret.txt"), "secret").unwrap();
    std::fs::write(inside.join("points.ply"), "ply\nformat ascii 1.0\nend_header\n").unwrap();
    std::fs::write(inside.join("secret.spz"), "secret").unwrap();
    std::fs::write(inside.join("deeper/deep.b2p"), SCENE).unwrap();
    std::fs::write(folder.path().join("outside.b2p"), SCENE).unwrap();
    #[cfg(unix)]
    std::os::unix::fs::symlink(folder.path().join("outside.b2p"), inside.join("link.b2p")).unwrap();
    let Some(serving) = Serving::start(folder.path(), "inside") else {
        return;
    };
    assert_eq!(serving.status("GET /scene.b2p HTTP/1.1"), 200);
    let refused = [
        "/secret.txt",
        "/points.ply",
        "/secret.spz",
        "/deeper/../scene.b2p",
        "/deeper/deep.b2p",
        "/../outside.b2p",
        "/%2e%2e/outside.b2p",
        "/..%2foutside.b2p",
        "/link.b2p",
        "//etc/passwd",
    ];
    for path in refused {
        assert_eq!(serving.status(&format!("GET {path} HTTP/1.1")), 404, "{path}");
    }
    for path in ["/%", "/%zz", &format!("/{}", "a".repeat(3000))] {
        assert_eq!(serving.status(&format!("GET {path} HTTP/1.1")), 400, "{path}");
    }
    assert_eq!(serving.status("POST /scene.b2p HTTP/1.1"), 405);
    assert_eq!(serving.status("DELETE /scene.b2p HTTP/1.1"), 405);
    let Some(alone) = Serving::start(folder.path(), "inside/scene.b2p") else {
        return;
    };
    assert_eq!(alone.status("GET /scene.b2p HTTP/1.1"), 200);
    assert_eq!(alone.status("GET /secret.txt HTTP/1.1"), 404);
}

#[test]
fn a_folder_without_streams_and_a_port_that_is_taken_are_reported() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("scene.b2p"), SCENE).unwrap();
    std::fs::create_dir(folder.path().join("empty")).unwrap();
    let Some(serving) = Serving::start(folder.path(), ".") else {
        return;
    };
    super::fails(folder.path(), &["serve", "empty"], &["no .b2p file"]);
    super::fails(folder.path(), &["serve", "missing.b2p"], &["missing.b2p"]);
    let port = serving.address.rsplit(':').next().unwrap();
    super::fails(folder.path(), &["serve", ".", "--port", port], &["cannot listen", port]);
}
