//! Holds `docs/format.md` against the streams: the Python decoder in `spec/`, written from that document, must decode
//! every conformance stream of version 3, every scene and every frame of a sequence to its digests, drawn as surfels and
//! with learned heads. Needs Python 3.10 with numpy; without them the test says so and passes.

#[path = "conformance/digest.rs"]
#[allow(dead_code, reason = "the suites have streams of version 2, too")]
mod digest;
#[path = "conformance/digest_transform.rs"]
#[allow(dead_code, reason = "the suites decode in pieces, too")]
mod digest_transform;

use std::path::Path;
use std::process::Command;

use b2p::gaussians::Heads;
use b2p::gaussians::learned::HeadsModel;

/// Runs Python in the repository's root; the exit status and all that it printed.
fn python(arguments: &[&str]) -> std::io::Result<(bool, String)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let output = Command::new("python3").args(arguments).current_dir(root).output()?;
    let printed = [output.stdout, output.stderr].concat();
    Ok((output.status.success(), String::from_utf8_lossy(&printed).into_owned()))
}

/// Whether Python and numpy are there; says so if not.
fn can_run() -> bool {
    let needed = "import sys, numpy; assert sys.version_info >= (3, 10), sys.version";
    match python(&["-c", needed]) {
        Ok((true, _)) => return true,
        Ok((false, why)) => println!("not run: {}", why.lines().last().unwrap_or_default()),
        Err(why) => println!("not run: python3: {why}"),
    }
    false
}

fn lines(file: &str) -> Vec<String> {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(file);
    let text = std::fs::read_to_string(file).expect("the suite is there");
    text.lines().map(str::to_owned).collect()
}

/// `tests/conformance` holds this library to the same list.
#[test]
fn the_second_decoder_refuses_every_damaged_stream_for_the_clause_that_it_breaks() {
    if !can_run() {
        return;
    }
    let list = "tests/data/conformance/damage.txt";
    let (success, printed) = python(&["spec/decode.py", "--damage", list]).expect("python3 was there a moment ago");
    assert!(success, "{printed}");
    let lines = lines(list);
    let of = |folder: &str| lines.iter().filter(|line| line.contains(folder)).count();
    let (frames, scenes, sequences) = (of(" version-3/"), of(" scenes/"), of(" sequences/"));
    assert!(frames >= 100, "{frames} damaged streams");
    assert!(scenes >= 50, "{scenes} damaged scenes");
    assert!(sequences >= 100, "{sequences} damaged sequences");
    let streams = frames + scenes + sequences;
    let expected = format!("{streams} damaged streams, 0 refused for another clause");
    assert!(printed.contains(&expected), "{printed}");
}

#[test]
fn a_decoder_written_from_the_document_decodes_the_conformance_streams() {
    decodes_all_of("version-3");
}

#[test]
fn a_decoder_written_from_the_document_decodes_and_draws_scenes_block_by_block() {
    decodes_all_of("scenes");
}

#[test]
fn a_decoder_written_from_the_document_decodes_and_draws_every_frame_of_sequences() {
    decodes_all_of("sequences");
}

#[test]
fn the_heads_that_ship_draw_the_same_gaussians_in_both_decoders() {
    if !can_run() {
        return;
    }
    let [stream, model] = [
        "tests/data/conformance/version-3/fine-steps.b2p",
        "models/heads.safetensors",
    ];
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let bytes = std::fs::read(root.join(stream)).expect("the suite is there");
    let heads = HeadsModel::open(&root.join(model)).expect("the heads that ship load");
    for quality in [Heads::Best, Heads::Quick] {
        let decoder = b2p::Decoder::new()
            .with_heads_model(heads.clone())
            .with_heads(quality.into());
        let expected = digest_transform::levels(&decoder, &bytes).expect("the stream decodes");
        let (success, printed) = python(&["spec/decode.py", stream, model, &quality.to_string()]).expect("python3");
        assert!(success, "{printed}");
        assert_eq!(printed.trim(), expected.join(" "), "{quality}");
    }
}

/// Decodes the streams of a suite and compares with its digests.
fn decodes_all_of(suite: &str) {
    if !can_run() {
        return;
    }
    let folder = format!("tests/data/conformance/{suite}");
    let (success, printed) = python(&["spec/decode.py", "--suite", &folder]).expect("python3 was there a moment ago");
    println!("{printed}");
    assert!(success, "{printed}");
    let lines = lines(&format!("{folder}/suite.txt"));
    let names = lines.iter().filter_map(|line| line.split(' ').next());
    let streams = names.filter(|name| !name.contains('/')).count();
    assert!(streams >= 7, "{streams} streams");
    assert!(printed.contains(&format!("{streams} streams, 0 differ")), "{printed}");
}
