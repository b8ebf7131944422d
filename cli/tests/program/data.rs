//! Data that packages have beside the program, as the folder that `B2P_DATA` names: the model of learned streams, and the
//! web page.

use std::path::Path;
use std::process::{Command, Output};

use super::serving::Serving;

const SAMPLE: &[u8] = include_bytes!("../../../models/sample.b2p");
const MODEL: &[u8] = include_bytes!("../../../models/lite.safetensors");

/// Runs the program with its data in `data`.
fn with_data(folder: &Path, data: &str, arguments: &[&str]) -> Output {
    let program = Command::new(env!("CARGO_BIN_EXE_b2p"))
        .current_dir(folder)
        .env("B2P_DATA", data)
        .args(arguments)
        .output();
    program.expect("the program starts")
}

#[test]
fn learned_streams_decode_alike_with_the_model_of_the_folder_and_say_where_it_is_missing() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    std::fs::write(at.join("sample.b2p"), SAMPLE).unwrap();
    std::fs::create_dir(at.join("data")).unwrap();
    let decode = ["decode", "sample.b2p", "-o", "outside.ply", "--level", "8"];
    let output = with_data(at, "data", &decode);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && !at.join("outside.ply").exists());
    assert!(
        errors.contains("data/lite.safetensors") && errors.contains("--model"),
        "{errors}"
    );
    std::fs::write(at.join("data/lite.safetensors"), MODEL).unwrap();
    assert!(with_data(at, "data", &decode).status.success());
    super::succeeds(at, &["decode", "sample.b2p", "-o", "inside.ply", "--level", "8"]);
    let read = |name: &str| std::fs::read(at.join(name)).unwrap();
    assert!(read("outside.ply") == read("inside.ply"));
}

#[test]
fn streams_of_version_3_need_no_data() {
    let folder = tempfile::tempdir().unwrap();
    let scene = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/scene.b2p");
    let scene = scene.to_str().unwrap();
    let decode = ["decode", scene, "-o", "scene.ply", "--level", "7", "--heads", "best"];
    assert!(with_data(folder.path(), "nowhere", &decode).status.success());
}

#[test]
fn the_page_of_the_folder_is_served_plain_and_compressed_and_nothing_beside_it() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    std::fs::write(at.join("sample.b2p"), SAMPLE).unwrap();
    let web = at.join("data/web");
    std::fs::create_dir_all(web.join("src")).unwrap();
    for (name, content) in [
        ("index.html", "<canvas>"),
        ("src/page.js", "1;"),
        ("notes.txt", "private"),
    ] {
        std::fs::write(web.join(name), content).unwrap();
    }
    let output = with_data(at, "data", &["serve", "sample.b2p", "--port", "0"]);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(
        !output.status.success() && errors.contains("data/web: the web page lacks b2p.wasm"),
        "{errors}"
    );
    std::fs::write(web.join("b2p.wasm.gz"), [0x1f, 0x8b, 8]).unwrap();
    let serving = Serving::start_with(at, "sample.b2p", &[("B2P_DATA", "data")]).expect("it has a page");
    let (head, page) = serving.ask("GET / HTTP/1.1");
    assert!(head.contains("text/html") && page == b"<canvas>");
    let (head, script) = serving.ask("GET /src/page.js HTTP/1.1");
    assert!(head.contains("text/javascript") && !head.contains("content-encoding") && script == b"1;");
    let (head, module) = serving.ask("GET /b2p.wasm HTTP/1.1");
    assert!(head.contains("application/wasm") && head.contains("content-encoding: gzip"));
    assert_eq!(module, [0x1f, 0x8b, 8]);
    for none in [
        "/notes.txt",
        "/web/index.html",
        "/../lite.safetensors",
        "/b2p-threads.wasm",
    ] {
        let (head, _) = serving.ask(&format!("GET {none} HTTP/1.1"));
        assert!(head.starts_with("http/1.1 404"), "{none}: {head}");
    }
}
