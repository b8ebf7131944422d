//! `b2p check` and `b2p upgrade`.

use super::*;

/// Exit code, standard output and standard error.
fn checked(folder: &Path, arguments: &[&str]) -> (Option<i32>, String, String) {
    let output = b2p(folder, &[&["check"], arguments].concat());
    let text = |bytes| String::from_utf8(bytes).expect("output is UTF-8");
    (output.status.code(), text(output.stdout), text(output.stderr))
}

#[test]
fn valid_streams_cut_streams_and_damaged_ones_are_distinguished() {
    let folder = folder_with_stream();
    let at = folder.path();
    let bytes = std::fs::read(at.join("ball.b2p")).unwrap();
    succeeds(at, &["cut", "--level", "5", "ball.b2p", "prefix.b2p"]);
    let end = std::fs::read(at.join("prefix.b2p")).unwrap().len();
    std::fs::write(at.join("cut.b2p"), &bytes[..end + 9]).unwrap();
    // The last chunk is a head map, which decoders may ignore, of 12 bytes.
    let mut damaged = bytes.clone();
    damaged[bytes.len() - 13] ^= 1;
    std::fs::write(at.join("damaged.b2p"), damaged).unwrap();

    let (code, said, errors) = checked(at, &["ball.b2p", "prefix.b2p"]);
    assert_eq!((code, &*errors), (Some(0), ""));
    assert!(said.contains("ball.b2p: valid\n"), "{said}");
    assert!(
        said.contains("prefix.b2p: valid: a prefix, complete to level 5 of 6"),
        "{said}"
    );

    let (code, said, errors) = checked(at, &["ball.b2p", "cut.b2p", "damaged.b2p", "missing.b2p"]);
    assert_eq!(code, Some(1), "{errors}");
    assert!(errors.contains("3 of 4 streams"), "{errors}");
    assert!(
        said.contains("cut.b2p: cut at byte ") && said.contains("but complete to level 5 of 6"),
        "{said}"
    );
    assert!(
        said.contains("damaged.b2p: not valid: 1 fault, complete to level 5 of 6"),
        "{said}"
    );
    assert!(said.contains("clause 3.1.1, level 6, byte "), "{said}");
    assert!(said.contains("missing.b2p"), "{said}");
}

#[test]
fn a_check_of_a_pipe_for_programs_says_clause_level_and_place() {
    let folder = folder_with_stream();
    let at = folder.path();
    let mut bytes = std::fs::read(at.join("ball.b2p")).unwrap();
    bytes.push(0);
    let output = piped(at, &["check", "-", "--json"], &bytes);
    assert_eq!(output.status.code(), Some(1));
    let said: Value = serde_json::from_slice(&output.stdout).expect("check prints JSON");
    let stream = &said[0];
    assert_eq!(
        (&stream["valid"], &stream["valid_to_level"]),
        (&false.into(), &6.into())
    );
    let fault = &stream["faults"][0];
    assert_eq!(
        (&fault["clause"], &fault["offset"]),
        (&"2.1.1".into(), &(bytes.len() - 1).into())
    );
    assert!(
        fault["what"].as_str().is_some_and(|what| what.contains("expected 0")),
        "{fault}"
    );
}

#[test]
fn a_chunk_that_this_version_does_not_know_is_mentioned_by_check_and_info() {
    let folder = folder_with_cloud();
    let at = folder.path();
    succeeds(at, &["encode", "ball.ply", "ball.b2p", "--bits", "7", "--up", "z"]);
    let mut bytes = std::fs::read(at.join("ball.b2p")).unwrap();
    let first = seal::chunks(&bytes)[0];
    assert_eq!(bytes[first], 128);
    bytes[first] = 222;
    seal::seal(&mut bytes);
    std::fs::write(at.join("newer.b2p"), bytes).unwrap();
    for command in ["check", "info"] {
        let said = succeeds(at, &[command, "newer.b2p"]);
        assert!(said.contains("skippable chunk of type 222"), "{command}: {said}");
        assert!(!succeeds(at, &[command, "ball.b2p"]).contains("skippable"));
    }
    succeeds(at, &["decode", "newer.b2p", "a.ply"]);
}

#[test]
fn a_stream_that_says_how_many_points_it_has_and_nothing_of_its_axes_is_usual() {
    let folder = folder_with_cloud();
    let at = folder.path();
    succeeds(at, &["encode", "ball.ply", "ball.b2p", "--bits", "6"]);
    assert!(succeeds(at, &["info", "ball.b2p"]).contains("made of"));
    for command in ["check", "info"] {
        let said = succeeds(at, &[command, "ball.b2p"]);
        assert!(!said.contains("note"), "{command}: {said}");
    }
}

#[test]
fn a_stream_of_version_2_becomes_one_of_version_3_with_the_same_geometry() {
    let folder = folder_with_learned_stream();
    let at = folder.path();
    succeeds(at, &["cut", "--level", "5", "ball.b2p", "five.b2p"]);
    for (input, level) in [("ball.b2p", 6), ("five.b2p", 5)] {
        let said = succeeds(at, &["upgrade", input, "new.b2p", "--json"]);
        let said: Value = serde_json::from_str(&said).expect("upgrade prints JSON");
        assert_eq!(said["levels"], serde_json::json!([4, level]));
        assert!(said["colour_psnr"].as_f64().is_some_and(|psnr| psnr > 25.0), "{said}");
        assert_eq!(checked(at, &["new.b2p"]).0, Some(0));
        let info = |stream: &str| -> Value {
            serde_json::from_str(&succeeds(at, &["info", stream, "--json"])).expect("info prints JSON")
        };
        let (old, new) = (info(input), info("new.b2p"));
        assert_eq!(
            (&new["version"], &new["points"], &new["bits"]),
            (&3.into(), &old["points"], &old["bits"])
        );
        assert_eq!(
            (&new["origin"], &new["voxel_size"]),
            (&old["origin"], &old["voxel_size"])
        );
        let voxels = |info: &Value| info["levels"][level - 4]["voxels"].clone();
        assert_eq!(voxels(&new), voxels(&old));
    }
    let said = succeeds(at, &["upgrade", "ball.b2p", "exact.b2p", "--lossless"]);
    assert!(
        said.contains("exact to 8 bits") && said.contains("shapes of Gaussians are not kept"),
        "{said}"
    );
    fails(
        at,
        &["upgrade", "exact.b2p", "x.b2p"],
        &["exact.b2p", "version 3 already"],
    );
}
