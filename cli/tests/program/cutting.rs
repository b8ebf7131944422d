//! `b2p cut`, `b2p info`, and files that end early.

use super::*;

fn info(at: &Path, stream: &str) -> Value {
    let info = succeeds(at, &["info", stream, "--json"]);
    serde_json::from_str(&info).expect("info prints JSON")
}

#[test]
fn a_cut_stream_decodes_to_the_level_that_it_was_cut_after() {
    for colours in ["transform", "learned"] {
        let folder = folder_coded(colours);
        let at = folder.path();
        let said = succeeds(at, &["cut", "--level", "5", "ball.b2p", "five.b2p"]);
        assert!(said.contains("level 5 of 6"), "{said}");
        let [whole, cut] = ["ball.b2p", "five.b2p"].map(|name| std::fs::read(at.join(name)).unwrap());
        assert!(cut.len() < whole.len() && whole.starts_with(&cut));
        succeeds(at, &["decode", "five.b2p", "a.ply"]);
        succeeds(at, &["decode", "ball.b2p", "b.ply", "--level", "5"]);
        let [a, b] = ["a.ply", "b.ply"].map(|name| std::fs::read(at.join(name)).unwrap());
        assert!(a == b);
        let text = succeeds(at, &["info", "five.b2p"]);
        assert!(
            text.contains("complete to level 5 of 6") && !text.contains("damage"),
            "{text}"
        );
        let info = info(at, "five.b2p");
        assert_eq!(info["complete_to_level"], 5);
        assert_eq!(info["top_level"], 6);
        assert!(info["damage"].is_null());
        fails(at, &["cut", "--level", "9", "ball.b2p", "x.b2p"], &["ball.b2p", "9"]);
        fails(
            at,
            &["cut", "--level", "6", "five.b2p", "x.b2p"],
            &["five.b2p", "truncated"],
        );
    }
}

#[test]
fn a_file_cut_within_a_level_is_drawn_and_decoded_as_a_pipe_is() {
    for colours in ["transform", "learned"] {
        let folder = folder_coded(colours);
        let at = folder.path();
        let whole = std::fs::read(at.join("ball.b2p")).unwrap();
        std::fs::write(at.join("cut.b2p"), &whole[..whole.len() - 1]).unwrap();
        let done = b2p(at, &["decode", "cut.b2p", "cut.ply"]);
        let said = String::from_utf8_lossy(&done.stderr).into_owned();
        assert!(done.status.success(), "{said}");
        assert!(
            said.contains("cut.b2p") && said.contains("truncated") && said.contains("level 5"),
            "{said}"
        );
        succeeds(at, &["decode", "ball.b2p", "five.ply", "--level", "5"]);
        let [cut, five] = ["cut.ply", "five.ply"].map(|name| std::fs::read(at.join(name)).unwrap());
        assert!(cut == five);
        let size = ["--size", "300x300"];
        succeeds(at, &[&["render", "cut.b2p", "cut.png"], &size[..]].concat());
        succeeds(
            at,
            &[&["render", "ball.b2p", "five.png", "--level", "5"], &size[..]].concat(),
        );
        assert!(png(&at.join("cut.png")).data() == png(&at.join("five.png")).data());
        let text = succeeds(at, &["info", "cut.b2p"]);
        assert!(text.contains("damage: ") && text.contains("6 (not complete)"), "{text}");
        assert!(info(at, "cut.b2p")["damage"].is_string());
    }
}

#[test]
fn info_tells_bits_by_part_model_and_grid() {
    let folder = folder_with_stream();
    let at = folder.path();
    let text = succeeds(at, &["info", "ball.b2p"]);
    for words in [
        "geometry bpp",
        "colour bpp",
        "no model needed",
        "grid: voxels of 1, 128 along each side",
    ] {
        assert!(text.contains(words), "{words}: {text}");
    }
    let info = info(at, "ball.b2p");
    let points = info["points"].as_f64().unwrap();
    for level in info["levels"].as_array().unwrap() {
        for part in ["geometry", "colour"] {
            let bytes = level[format!("{part}_bytes")].as_f64().unwrap();
            let bits = level[format!("{part}_bits_per_point")].as_f64().unwrap();
            assert!((bits - 8.0 * bytes / points).abs() < 1e-9);
        }
    }
    assert_eq!(info["voxel_size"], 1.0);
}

#[test]
fn an_error_says_what_a_file_of_a_wrong_kind_is_and_what_to_do() {
    let folder = folder_with_stream();
    let at = folder.path();
    let mut las = b"LASF".to_vec();
    las.resize(300, 0);
    (las[24], las[25]) = (1, 2);
    std::fs::write(at.join("scan.ply"), &las).unwrap();
    succeeds(at, &["decode", "ball.b2p", "splats.ply"]);
    for command in ["info", "decode", "render"] {
        let to: &[&str] = if command == "info" { &[] } else { &["-o", "x.png"] };
        fails(at, &[&[command, "scan.ply"], to].concat(), &["scan.ply", "LAS 1.2"]);
    }
    let said = succeeds(at, &["encode", "splats.ply", "splats.b2p"]);
    assert!(said.contains("centres are taken as points"), "{said}");
    fails(at, &["info", "splats.ply"], &["splats.ply", "Gaussians", "b2p render"]);
    fails(at, &["decode", "ball.ply", "x.ply"], &["ball.ply", "b2p encode"]);
    fails(at, &["encode", "ball.b2p", "x.b2p"], &["ball.b2p", "stream of b2p"]);
    let mesh = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
                element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n";
    std::fs::write(at.join("mesh.ply"), mesh).unwrap();
    fails(
        at,
        &["encode", "mesh.ply", "x.b2p"],
        &["mesh.ply", "a mesh", "sample it"],
    );
    fails(
        at,
        &["render", "mesh.ply", "x.png"],
        &["mesh.ply", "a mesh", "sample it"],
    );
}
