//! Gaussians in the formats of other programs.

use b2p::gaussians::Gaussians;
use b2p::{Limits, Placement};
use b2p_formats::splats::{Axes, Format, Options, read, write};

use super::*;

/// Gaussians of a file as PLY has them.
fn splats(at: &Path, name: &str) -> Gaussians {
    let bytes = std::fs::read(at.join(name)).unwrap();
    let format = Format::of_path(Path::new(name)).unwrap();
    let splats = read(&bytes, format, &Options::default(), &Limits::default()).unwrap();
    splats.into_cloud()
}

/// Corners of the box around the centres, in the world.
fn corners(g: &Gaussians) -> [[f64; 3]; 2] {
    let mut corners = [[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]];
    for &position in &g.position {
        let place = g.frame.placement.from_cube(g.frame.bits, position);
        for k in 0..3 {
            corners[0][k] = corners[0][k].min(place[k]);
            corners[1][k] = corners[1][k].max(place[k]);
        }
    }
    corners
}

#[test]
fn a_stream_is_decoded_to_every_format_and_each_is_converted_back_and_drawn() {
    let folder = folder_with_stream();
    let at = folder.path();
    succeeds(at, &["decode", "ball.b2p", "plain.ply"]);
    let plain = splats(at, "plain.ply");
    for format in Format::all() {
        let name = format!("ball{}", format.extension());
        let said = succeeds(at, &["decode", "ball.b2p", &name]);
        assert!(said.contains("Gaussians"), "{said}");
        let bytes = std::fs::read(at.join(&name)).unwrap();
        succeeds(at, &["decode", "ball.b2p", "other.ply", "--format", format.name()]);
        assert_eq!(std::fs::read(at.join("other.ply")).unwrap(), bytes);
        succeeds(at, &["convert", &name, "back.ply"]);
        let back = splats(at, "back.ply");
        assert_eq!(back.len(), plain.len(), "{format}");
        for (a, b) in corners(&plain).iter().zip(corners(&back)) {
            assert!((0..3).all(|k| (a[k] - b[k]).abs() < 0.1), "{format}: {a:?} {b:?}");
        }
        succeeds(at, &["render", &name, "picture.png", "--size", "32x32"]);
        // By its contents, whatever its name is.
        if !matches!(format, Format::Splat | Format::Csv) {
            std::fs::rename(at.join(&name), at.join("nameless")).unwrap();
            succeeds(at, &["render", "nameless", "picture.png", "--size", "32x32"]);
        }
    }
}

#[test]
fn the_centres_of_gaussians_are_written_as_points() {
    let folder = folder_with_stream();
    let at = folder.path();
    succeeds(at, &["decode", "ball.b2p", "ball.spz"]);
    succeeds(at, &["convert", "ball.spz", "points.ply", "--points"]);
    let points = std::fs::read(at.join("points.ply")).unwrap();
    let points = b2p::cloud::PointCloud::from_ply(&points, &Limits::default()).unwrap();
    assert_eq!(points.positions.len(), splats(at, "ball.spz").len());
}

#[test]
fn pipes_convert_too() {
    let folder = folder_with_stream();
    let at = folder.path();
    succeeds(at, &["decode", "ball.b2p", "ball.sog"]);
    let sog = std::fs::read(at.join("ball.sog")).unwrap();
    let output = piped(at, &["convert", "-", "-", "--format", "spz"], &sog);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(Format::of_bytes(&output.stdout), Some(Format::Spz));
    let output = piped(at, &["render", "-", "piped.png", "--size", "16x16"], &sog);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn coordinates_far_from_the_origin_are_local_with_the_offset_beside() {
    let folder = folder_with_stream();
    let at = folder.path();
    succeeds(at, &["decode", "ball.b2p", "ball.ply"]);
    let mut far = splats(at, "ball.ply");
    far.frame.placement = Placement {
        origin: [500_123.4, 4_649_876.5, 12.0],
        voxel_size: 0.01,
    };
    let mut bytes = Vec::new();
    write(&far, Axes::Ply, Format::Ply, &mut bytes, Path::new("far.ply")).unwrap();
    std::fs::write(at.join("far.ply"), bytes).unwrap();
    let expected = corners(&far);
    for format in Format::all() {
        let name = format!("there{}", format.extension());
        let output = b2p(at, &["convert", "far.ply", &name]);
        assert!(output.status.success());
        let beside = at.join(format!("{name}.json"));
        let whole = matches!(format, Format::Csv | Format::Glb | Format::Gltf);
        assert_eq!(beside.exists(), !whole, "{format}");
        let errors = String::from_utf8_lossy(&output.stderr);
        assert_eq!(
            errors.contains("less an offset of 500124 4649877 0"),
            !whole,
            "{errors}"
        );
        succeeds(at, &["convert", &name, "back.csv"]);
        for (a, b) in expected.iter().zip(corners(&splats(at, "back.csv"))) {
            assert!((0..3).all(|k| (a[k] - b[k]).abs() < 0.01), "{format}: {a:?} {b:?}");
        }
    }
}

#[test]
fn what_cannot_be_converted_is_named() {
    let folder = folder_with_stream();
    let at = folder.path();
    fails(at, &["convert", "ball.b2p", "x.spz"], &["ball.b2p", "b2p decode"]);
    fails(
        at,
        &["convert", "ball.ply", "x.spz"],
        &["ball.ply", "not Gaussians", "b2p encode", "--surfels"],
    );
    fails(
        at,
        &["decode", "ball.b2p", "x.obj"],
        &["x.obj", "no splats end in .obj", ".compressed.ply", "--format"],
    );
    std::fs::write(at.join("what"), b"what").unwrap();
    fails(at, &["convert", "what", "x.spz"], &["what", "--from", "compressed-ply"]);
    fails(at, &["convert", "what", "x.spz", "--from", "spz"], &["magic", "NGSP"]);
}

fn cloud(at: &Path, name: &str) -> b2p::cloud::PointCloud {
    let read = b2p_formats::clouds::open(&at.join(name), &Limits::default(), &Default::default());
    read.expect("a point cloud").cloud
}

/// A text of points that no grid fits, at places like those of UTM.
fn scan() -> String {
    let place = |i: u32| 500_000.0 + f64::from(i * 7919 % 1009) * 0.001;
    let row = |i: u32| format!("{} {} {} {} {} 7\n", place(i), place(i + 5), i % 50, i % 256, i / 256);
    (0..1000).map(row).collect()
}

#[test]
fn points_are_converted_between_all_formats_with_axes_unit_and_coordinate_system() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    std::fs::write(at.join("scan.xyz"), scan()).unwrap();
    let axes = ["--up", "-x", "--unit", "ft"];
    succeeds(at, &[&["convert", "scan.xyz", "0.ply"][..], &axes].concat());
    let first = cloud(at, "0.ply");
    assert_eq!(first.axes.up, Some(b2p::Up::MinusX));
    let names = ["1.las", "2.pcd", "3.laz", "4.e57", "5.xyz", "6.ply"];
    for (from, to) in ["0.ply"].iter().chain(&names).zip(&names) {
        succeeds(at, &["convert", from, to]);
    }
    let last = cloud(at, "6.ply");
    assert_eq!((&last.axes, &last.colours), (&first.axes, &first.colours));
    for (a, b) in first.positions.iter().zip(&last.positions) {
        assert!((0..3).all(|k| (a[k] - b[k]).abs() < 1e-9), "{a:?} {b:?}");
    }
    // Only formats that cannot say all have a file beside.
    for (name, beside) in [
        ("1.las", true),
        ("2.pcd", true),
        ("4.e57", true),
        ("0.ply", false),
        ("6.ply", false),
    ] {
        assert_eq!(at.join(format!("{name}.json")).exists(), beside, "{name}");
    }
}

#[test]
fn what_stands_beside_a_file_is_read_with_it_and_goes_with_it() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    std::fs::write(at.join("scan.xyz"), scan()).unwrap();
    let near = ["convert", "scan.xyz", "near.pcd", "--local", "--up", "z", "--unit", "m"];
    let said = b2p(at, &near);
    let said = String::from_utf8_lossy(&said.stderr).into_owned();
    assert!(said.contains("less an offset of 500000 500000 0"), "{said}");
    assert!(said.contains("near.pcd.json states offset, up axis, unit"), "{said}");
    assert!(cloud(at, "near.pcd").positions.iter().all(|p| p[0] < 2.0));
    succeeds(at, &["encode", "near.pcd", "x.b2p", "--bits", "10"]);
    let info: Value = serde_json::from_str(&succeeds(at, &["info", "x.b2p", "--json"])).unwrap();
    assert!(info["origin"][0].as_f64().unwrap() > 499_000.0, "{info}");
    assert_eq!(
        (&info["up"], &info["metres_per_unit"]),
        (&Value::from("z"), &Value::from(1.0))
    );
    // A box is in the coordinates of the world.
    let cropped = [
        "convert",
        "near.pcd",
        "box.ply",
        "--crop",
        "500000,500000,0,500000.5,500001,60",
    ];
    succeeds(at, &cropped);
    assert!(cloud(at, "box.ply").positions.len() < 600);
    // A file without an offset takes its place.
    let said = b2p(at, &["convert", "scan.xyz", "near.pcd"]);
    assert!(String::from_utf8_lossy(&said.stderr).contains("removed near.pcd.json"));
    assert!(!at.join("near.pcd.json").exists());
    // A file of another program is not replaced without permission, and not read.
    std::fs::write(at.join("other.pcd.json"), "{\"offset\":[1,2,3]}").unwrap();
    let refused = plain(at, &["convert", "scan.xyz", "other.pcd", "--local"]);
    assert!(String::from_utf8_lossy(&refused.stderr).contains("other.pcd.json exists already"));
    assert!(!at.join("other.pcd").exists());
}

#[test]
fn gaussians_become_points_only_where_nothing_else_can_be_meant() {
    let folder = folder_with_stream();
    let at = folder.path();
    succeeds(at, &["decode", "ball.b2p", "ball.spz"]);
    let count = splats(at, "ball.spz").len();
    let said = b2p(at, &["convert", "ball.spz", "centres.laz"]);
    let said = String::from_utf8_lossy(&said.stderr).into_owned();
    assert!(said.contains("only the centres and colours"), "{said}");
    assert_eq!(cloud(at, "centres.laz").positions.len(), count);
    succeeds(at, &["convert", "ball.spz", "same.ply"]);
    assert_eq!(splats(at, "same.ply").len(), count);
    fails(
        at,
        &["convert", "ball.spz", "x.ply", "--crop", "0,0,0,1,1,1"],
        &["--crop is for points"],
    );
    let formats = ["convert", "ball.spz", "x", "--points", "--format", "sog"];
    fails(at, &formats, &["sog is for Gaussians"]);
}

#[test]
fn points_become_gaussians_only_as_surfels() {
    let folder = folder_with_cloud();
    let at = folder.path();
    for name in ["x.spz", "x.compressed.ply", "x.glb"] {
        fails(
            at,
            &["convert", "ball.ply", name],
            &["not Gaussians", "b2p encode", "--surfels"],
        );
    }
    succeeds(at, &["convert", "ball.ply", "flat.sog", "--surfels"]);
    assert!(splats(at, "flat.sog").len() > 1000);
    succeeds(at, &["render", "flat.sog", "x.png", "--size", "32x32"]);
}

/// The place of the only red Gaussian, less that of the middle of all.
fn red(g: &Gaussians) -> [f64; 3] {
    let places: Vec<_> = g
        .position
        .iter()
        .map(|&p| g.frame.placement.from_cube(g.frame.bits, p))
        .collect();
    let red = (0..g.len()).filter(|&i| g.colour[i][0] > 0.6 && g.colour[i][2] < 0.4);
    let red: Vec<_> = red.map(|i| places[i]).collect();
    assert!(!red.is_empty());
    let mean = |all: &[[f64; 3]], k: usize| all.iter().map(|p| p[k]).sum::<f64>() / all.len() as f64;
    [0, 1, 2].map(|k| mean(&red, k) - mean(&places, k))
}

#[test]
fn scenes_stand_upright_in_viewers_and_come_back_as_they_were() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    // A blue floor, with a red tower at its end along x and y; z is up.
    let mut rows = String::new();
    for i in 0..40 {
        (0..40).for_each(|j| rows += &format!("{i} {j} 0 0 0 255\n"));
        (0..16).for_each(|j| rows += &format!("{} {} {i} 255 0 0\n", 36 + j % 4, 36 + j / 4));
    }
    std::fs::write(at.join("tower.xyz"), rows).unwrap();
    let encode = [
        "encode",
        "tower.xyz",
        "t.b2p",
        "--bits",
        "6",
        "--lossless",
        "--levels",
        "3..6",
        "--up",
    ];
    succeeds(at, &[&encode[..], &["z"]].concat());
    for format in Format::all() {
        let name = format!("t{}", format.extension());
        let said = b2p(at, &["decode", "t.b2p", &name, "--heads", "surfels"]);
        let said = String::from_utf8_lossy(&said.stderr).into_owned();
        assert!(
            said.contains("turned from z up") && said.contains("--keep-axes"),
            "{format}: {said}"
        );
        // To this one: the coordinates of the cloud again.
        succeeds(at, &["convert", &name, "back.xyz"]);
        let back = cloud(at, "back.xyz");
        let (low, high) = back
            .positions
            .iter()
            .fold(([1e9f64; 3], [-1e9f64; 3]), |(low, high), p| {
                (
                    [0, 1, 2].map(|k| low[k].min(p[k])),
                    [0, 1, 2].map(|k| high[k].max(p[k])),
                )
            });
        assert!(
            (0..3).all(|k| low[k] > -1.5 && high[k] < 41.5 && high[k] > 38.0),
            "{format}: {low:?} {high:?}"
        );
        assert!(
            std::fs::read_to_string(at.join("back.xyz.json"))
                .unwrap()
                .contains("\"up\": \"z\"")
        );
        // A picture has the tower above the floor.
        succeeds(at, &["render", &name, "x.png", "--size", "48x48", "--orbit", "0,20"]);
        let picture = png(&at.join("x.png"));
        let reds = |rows: std::ops::Range<u32>| {
            let pixels = rows.flat_map(|y| (0..48).map(move |x| (x, y)));
            let is = |&(x, y): &(u32, u32)| picture.pixel(x, y).is_some_and(|p| p.red() > 150 && p.blue() < 90);
            pixels.filter(is).count()
        };
        assert!(reds(0..24) > reds(24..48), "{format}");
    }
    // To programs that know nothing of the turn: −y is up, in glTF +y.
    let alone = at.join("alone");
    std::fs::create_dir_all(&alone).unwrap();
    let csv = ["decode", "t.b2p", "alone/t.csv", "--heads", "surfels"];
    succeeds(at, &csv);
    std::fs::remove_file(alone.join("t.csv.json")).unwrap();
    assert!(red(&splats(&alone, "t.csv"))[1] < -5.0);
    succeeds(
        at,
        &["decode", "t.b2p", "kept.csv", "--heads", "surfels", "--keep-axes"],
    );
    assert!(red(&splats(at, "kept.csv"))[2] > 5.0);
    // The axis can be said, too.
    succeeds(at, &["decode", "t.b2p", "x.csv", "--heads", "surfels", "--up", "-z"]);
    std::fs::remove_file(at.join("x.csv.json")).unwrap();
    assert!(red(&splats(at, "x.csv"))[1] > 5.0);
    // What comes from a pipe is turned like a file.
    let stream = std::fs::read(at.join("t.b2p")).unwrap();
    let from_pipe = piped(at, &["decode", "-", "piped.ply", "--heads", "surfels"], &stream);
    assert!(from_pipe.status.success());
    assert_eq!(
        std::fs::read(at.join("piped.ply")).unwrap(),
        std::fs::read(at.join("t.ply")).unwrap()
    );
}
