//! `--quality` and `--effort`.

use super::*;

#[test]
fn more_quality_takes_more_bytes_and_its_ends_are_coarse_and_lossless() {
    let folder = folder_with_cloud();
    let at = folder.path();
    let bytes = |quality: &str| {
        succeeds(at, &["encode", "ball.ply", "q.b2p", "--quality", quality]);
        std::fs::metadata(at.join("q.b2p")).unwrap().len()
    };
    let sizes: Vec<u64> = ["0", "15", "30", "45", "60", "75", "90", "100"].map(bytes).to_vec();
    assert!(sizes.is_sorted_by(|a, b| a < b), "{sizes:?}");
    let info: Value = serde_json::from_str(&succeeds(at, &["info", "q.b2p", "--json"])).unwrap();
    assert_eq!(info["top_level"], 7);
    assert_eq!(info["levels"].as_array().unwrap().last().unwrap()["lossless"], true);
    for conflict in [["--step", "8"], ["--bits-per-point", "1"]] {
        let done = b2p(
            at,
            &[&["encode", "ball.ply", "q.b2p", "-Q", "50"], &conflict[..]].concat(),
        );
        assert_eq!(done.status.code(), Some(2), "{conflict:?}");
    }
    assert_eq!(
        b2p(at, &["encode", "ball.ply", "q.b2p", "--quality", "101"])
            .status
            .code(),
        Some(2)
    );
    let learned = ["encode", "ball.ply", "q.b2p", "--colours", "learned", "--quality", "50"];
    fails(at, &learned, &["--quality", "--colours transform"]);
    let learned = ["encode", "ball.ply", "q.b2p", "--colours", "learned", "--tune", "psnr"];
    fails(at, &learned, &["--tune", "--colours transform"]);
}

#[test]
fn little_effort_leaves_steps_out_and_7_is_the_default() {
    let folder = folder_with_cloud();
    let at = folder.path();
    let coded = |effort: &[&str]| {
        let encode = ["encode", "ball.ply", "e.b2p", "--bits-per-point", "1", "-v"];
        let said = succeeds(at, &[&encode, effort].concat());
        (std::fs::read(at.join("e.b2p")).unwrap(), said)
    };
    let tries = |said: &str| said.lines().filter(|line| line.starts_with("try ")).count();
    let (usual, _) = coded(&[]);
    let (same, said) = coded(&["--effort", "7"]);
    assert!(usual == same);
    let (least, quick) = coded(&["--effort", "0"]);
    assert!(least != usual && tries(&quick) <= tries(&said), "{quick}{said}");
}

#[test]
fn most_effort_compares_pictures_from_all_sides() {
    let folder = folder_with_cloud();
    let at = folder.path();
    let encode = ["encode", "ball.ply", "e.b2p", "--step", "40", "-v", "--effort"];
    for (effort, most) in [("7", 0), ("8", 3), ("9", 9)] {
        let said = succeeds(at, &[&encode[..], &[effort]].concat());
        let compared = said.lines().filter(|line| line.starts_with("compare from all sides"));
        let compared = compared.count();
        assert!(compared <= most && (compared > 0) == (most > 0), "{said}");
        succeeds(at, &["check", "e.b2p"]);
    }
}

#[test]
fn gaussians_reach_as_far_as_the_cloud_if_asked_for_in_streams_and_sequences() {
    let folder = folder_with_cloud();
    let at = folder.path();
    std::fs::create_dir(at.join("frames")).unwrap();
    for frame in ["a.ply", "b.ply"] {
        std::fs::copy(at.join("ball.ply"), at.join("frames").join(frame)).unwrap();
    }
    for input in ["ball.ply", "frames"] {
        let gaussians = ["surface", "cloud"].map(|outline| {
            let encode = ["encode", input, "-o", "o.b2p", "--bits", "7", "--outline", outline];
            succeeds(at, &encode);
            let decode = ["decode", "o.b2p", "-o", "o.ply", "--heads", "best"];
            let frame: &[&str] = if input == "frames" { &["--frame", "1"] } else { &[] };
            succeeds(at, &[&decode[..], frame].concat());
            std::fs::read(at.join("o.ply")).unwrap()
        });
        assert_eq!(gaussians[0].len(), gaussians[1].len());
        assert!(gaussians[0] != gaussians[1], "{input}");
    }
    let other = b2p(at, &["encode", "ball.ply", "-o", "o.b2p", "--outline", "mesh"]);
    assert_eq!(other.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&other.stderr).contains("expected surface or cloud"));
    let learned = [
        "encode",
        "ball.ply",
        "-o",
        "q.b2p",
        "--colours",
        "learned",
        "--outline",
        "cloud",
    ];
    fails(at, &learned, &["--outline", "--colours transform"]);
}
