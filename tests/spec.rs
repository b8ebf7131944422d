//! Holds `docs/format.md` against the streams: the Python decoder in `spec/`, written from that document, must decode
//! every conformance stream of version 3 to its digests. Needs Python 3.10 with numpy; without them the test says so
//! and passes.

use std::path::Path;
use std::process::Command;

/// Runs Python in the repository's root; the exit status and all that it printed.
fn python(arguments: &[&str]) -> std::io::Result<(bool, String)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let output = Command::new("python3").args(arguments).current_dir(root).output()?;
    let printed = [output.stdout, output.stderr].concat();
    Ok((output.status.success(), String::from_utf8_lossy(&printed).into_owned()))
}

#[test]
fn a_decoder_written_from_the_document_decodes_the_conformance_streams() {
    let needed = "import sys, numpy; assert sys.version_info >= (3, 10), sys.version";
    match python(&["-c", needed]) {
        Ok((true, _)) => (),
        Ok((false, why)) => return println!("not run: {}", why.lines().last().unwrap_or_default()),
        Err(why) => return println!("not run: python3: {why}"),
    }
    let suite = ["spec/decode.py", "--suite", "tests/data/conformance/version-3"];
    let (success, printed) = python(&suite).expect("python3 was there a moment ago");
    println!("{printed}");
    assert!(success, "{printed}");
    let list = Path::new(env!("CARGO_MANIFEST_DIR")).join(suite[2]).join("suite.txt");
    let streams = std::fs::read_to_string(list)
        .expect("the suite is there")
        .lines()
        .count();
    assert!(printed.contains(&format!("{streams} streams, 0 differ")), "{printed}");
}
