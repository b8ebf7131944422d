//! Point clouds of every kind in, points of every kind out.

use b2p::cloud::{PointCloud, ReadOptions, voxelise};
use b2p_formats::clouds;

use super::*;

fn read(path: &Path) -> PointCloud {
    let read = clouds::open(path, &b2p::Limits::default(), &ReadOptions::default());
    read.expect("a point cloud").cloud
}

#[test]
fn points_in_every_format_are_the_voxels_and_are_read_again() {
    let folder = folder_with_cloud();
    let at = folder.path();
    let lossless = [
        "encode",
        "ball.ply",
        "-o",
        "ball.b2p",
        "--lossless",
        "--levels",
        "5..7",
        "--up",
        "-z",
        "--unit",
        "mm",
    ];
    succeeds(at, &lossless);
    let info = succeeds(at, &["info", "ball.b2p"]);
    assert!(
        info.contains("-z points up") && info.contains("unit of length: mm"),
        "{info}"
    );
    let original = read(&at.join("ball.ply"));
    for name in ["x.ply", "x.las", "x.laz", "x.pcd", "x.e57", "x.xyz"] {
        succeeds(at, &["decode", "ball.b2p", "--points", "-o", name]);
        let back = read(&at.join(name));
        let grids = [&back, &original].map(|cloud| voxelise(cloud, Some(7)).unwrap());
        assert_eq!(grids[0].voxels.len(), original.positions.len(), "{name}");
        assert_eq!(grids[0].colours, grids[1].colours, "{name}");
        // And coded again.
        succeeds(at, &["encode", name, "-o", "again.b2p", "--bits", "7"]);
    }
    assert_eq!(read(&at.join("x.ply")).axes.metres_per_unit, Some(0.001));
    succeeds(at, &["decode", "ball.b2p", "--points", "--local", "-o", "local.ply"]);
    let sidecar: Value = serde_json::from_str(&std::fs::read_to_string(at.join("local.ply.json")).unwrap()).unwrap();
    assert_eq!(sidecar["up"], "-z");
}

#[test]
fn what_is_mended_is_said_and_refused_if_strict() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let mut rows = String::from("x,y,z,red,green,blue\n");
    for i in 0..400 {
        rows += &format!("{},{},0.5,{},0,0\n", i % 20, f64::from(i / 20) + 0.5, i % 256);
    }
    std::fs::write(at.join("scan.csv"), rows.clone() + "nan,1,2,0,0,0\ninf,0,0,0,0,0\n").unwrap();
    let output = b2p(at, &["encode", "scan.csv", "-o", "x.b2p"]);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(
        output.status.success() && errors.contains("left out 2 points of 402: not finite"),
        "{errors}"
    );
    assert!(
        errors.contains("400 points → ") && errors.contains(" bits)"),
        "{errors}"
    );
    std::fs::remove_file(at.join("x.b2p")).unwrap();
    fails(
        at,
        &["encode", "scan.csv", "-o", "x.b2p", "--strict"],
        &["scan.csv", "point 400", "finite"],
    );
    let cropped = ["encode", "scan.csv", "-o", "x.b2p", "--crop", "0,0,0,4,4,1"];
    let output = b2p(at, &cropped);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(errors.contains("left out 380 points: outside of the box"), "{errors}");
    fails(
        at,
        &["encode", "scan.csv", "-o", "y.b2p", "--crop", "50,50,50,60,60,60"],
        &["no point is in the box"],
    );
}

#[test]
fn stray_points_leave_the_detail_and_can_be_dropped() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let ball = sparse_ball(60_000);
    let strays = "900 0 0 1 2 3\n0 -800 0 1 2 3\n3 4 700 1 2 3\n";
    std::fs::write(at.join("ball.ply"), &ball).unwrap();
    let with = ball.replace("vertex 60000", "vertex 60003") + strays;
    std::fs::write(at.join("strays.ply"), with).unwrap();
    let voxels = |name: &str, more: &[&str]| -> f64 {
        succeeds(at, &[&["encode", name, "-o", "x.b2p"], more].concat());
        let info = succeeds(at, &["info", "x.b2p", "--json"]);
        let info: Value = serde_json::from_str(&info).unwrap();
        info["points"].as_f64().unwrap()
    };
    let alone = voxels("ball.ply", &[]);
    let merged = succeeds(at, &["info", "x.b2p"]);
    assert!(
        merged.contains("made of 60 000 points in ") && merged.contains(" % merged"),
        "{merged}"
    );
    assert!(voxels("strays.ply", &[]) > 0.6 * alone);
    assert_eq!(voxels("strays.ply", &["--drop-outliers"]), alone);
}

#[test]
fn points_inside_of_a_closed_surface_are_left_out_on_request() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let ball = sparse_ball(60_000);
    std::fs::write(at.join("ball.ply"), &ball).unwrap();
    let inside: String = (10..60).map(|i| format!("0.{i} 0.1 0.2 9 9 9\n")).collect();
    let with = ball.replace("vertex 60000", "vertex 60050") + &inside;
    std::fs::write(at.join("filled.ply"), with).unwrap();
    succeeds(at, &["encode", "ball.ply", "-o", "ball.b2p"]);
    let encode = ["encode", "filled.ply", "-o", "filled.b2p", "--drop-hidden"];
    let said = String::from_utf8(b2p(at, &encode).stderr).unwrap();
    assert!(said.contains("left out 50 points: not seen from outside"), "{said}");
    let [ball, filled] = ["ball.b2p", "filled.b2p"].map(|name| std::fs::read(at.join(name)).unwrap());
    assert!(ball == filled);
}

#[test]
fn point_clouds_are_drawn_and_described() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    std::fs::write(at.join("ball.ply"), sparse_ball(20_000)).unwrap();
    let render = ["render", "ball.ply", "-o", "x.png", "--size", "64x64"];
    succeeds(at, &render);
    let picture = png(&at.join("x.png"));
    let drawn = |x: u32, y: u32| picture.pixel(x, y).expect("a pixel").green() < 200;
    assert!(drawn(32, 32) && !drawn(1, 1));
    let holes = (28..36)
        .flat_map(|y| (28..36).map(move |x| (x, y)))
        .filter(|&(x, y)| !drawn(x, y));
    assert_eq!(holes.count(), 0, "the surface is closed");
    let info = succeeds(at, &["info", "ball.ply"]);
    assert!(
        info.contains("20 000 points") && info.contains("as a stream: 20,000 points → "),
        "{info}"
    );
    let info: Value = serde_json::from_str(&succeeds(at, &["info", "ball.ply", "--json"])).unwrap();
    assert_eq!(info["points"], 20_000);
    let piped = piped(
        at,
        &["render", "-", "-o", "y.png", "--size", "64x64"],
        sparse_ball(20_000).as_bytes(),
    );
    assert!(piped.status.success());
    assert_eq!(
        std::fs::read(at.join("x.png")).unwrap(),
        std::fs::read(at.join("y.png")).unwrap()
    );
}

#[test]
fn a_cloud_with_z_up_is_drawn_upright() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    // A red floor with a blue wall on it, z up.
    let mut rows = String::new();
    for i in 0..60 {
        for j in 0..60 {
            rows += &format!("{i} {j} 0 255 0 0\n");
            rows += &format!("{i} 59 {j} 0 0 255\n");
        }
    }
    std::fs::write(at.join("room.xyz"), rows).unwrap();
    succeeds(
        at,
        &[
            "encode", "room.xyz", "-o", "room.b2p", "--up", "z", "--bits", "6", "--levels", "3..6",
        ],
    );
    succeeds(
        at,
        &[
            "render", "room.b2p", "-o", "x.png", "--size", "64x64", "--orbit", "0,30,3",
        ],
    );
    let picture = png(&at.join("x.png"));
    let count = |rows: std::ops::Range<u32>, blue: bool| {
        let pixels = rows.flat_map(|y| (0..64).map(move |x| (x, y)));
        let is = |&(x, y): &(u32, u32)| {
            let pixel = picture.pixel(x, y).expect("a pixel");
            let (r, b) = (pixel.red(), pixel.blue());
            if blue { b > 150 && r < 100 } else { r > 150 && b < 100 }
        };
        pixels.filter(is).count()
    };
    assert!(count(0..32, true) > 2 * count(0..32, false), "the wall is above");
    assert!(count(32..64, false) > 2 * count(32..64, true), "the floor is below");
}

#[test]
fn what_is_no_cloud_is_named_with_what_to_do() {
    let folder = folder_with_stream();
    let at = folder.path();
    std::fs::write(at.join("mesh.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").unwrap();
    fails(
        at,
        &["encode", "mesh.obj", "-o", "x.b2p"],
        &["mesh.obj", "this is a mesh", "voxelize"],
    );
    fails(
        at,
        &["decode", "ball.ply", "-o", "x.ply"],
        &["ball.ply", "a PLY file", "b2p encode"],
    );
    fails(
        at,
        &["encode", "ball.b2p", "-o", "x.b2p"],
        &["ball.b2p", "a stream of b2p", "b2p decode"],
    );
    std::fs::write(at.join("a.las"), [&b"LASF"[..], &[0; 300]].concat()).unwrap();
    fails(at, &["encode", "a.las", "-o", "x.b2p"], &["a.las", "LAS"]);
}

#[test]
fn no_more_is_read_than_the_limits_allow() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let limited = ["--max-memory", "1M", "encode"];
    fails(
        at,
        &[&limited[..], &["/dev/zero", "-o", "x.b2p"]].concat(),
        &["1048577", "--max-memory"],
    );
    let big = piped(
        at,
        &[&limited[..], &["-", "-o", "x.b2p"]].concat(),
        &vec![b'1'; 2 << 20],
    );
    assert_eq!(big.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&big.stderr).contains("--max-memory"));
}

#[test]
fn the_memory_limit_holds_for_encoding_too() {
    let folder = folder_with_cloud();
    let at = folder.path();
    let voxelised = b2p::cloud::voxelise_memory(read(&at.join("ball.ply")).positions.len() as u64);
    let limit = (voxelised + (8 << 20)).to_string();
    let limited = ["encode", "ball.ply", "x.b2p", "--bits", "7", "--max-memory", &limit];
    fails(at, &limited, &["encoding the voxels", "--max-memory"]);
    assert!(!at.join("x.b2p").exists());
}

#[test]
fn memory_for_voxels_counts_and_damage_in_readers_of_others_is_said_once() {
    let folder = folder_with_cloud();
    let at = folder.path();
    succeeds(at, &["convert", "ball.ply", "ball.e57"]);
    succeeds(at, &["convert", "ball.ply", "ball.las"]);
    let bytes = std::fs::metadata(at.join("ball.ply")).unwrap().len();
    let points = read(&at.join("ball.ply")).positions.len() as u64;
    // Enough to read the file, not to voxelise it.
    let between = (bytes.max(49 * points) + b2p::cloud::voxelise_memory(points)) / 2;
    let limited = ["encode", "ball.ply", "x.b2p", "--max-memory", &between.to_string()];
    fails(at, &limited, &["a cloud and its voxels", "--max-memory"]);
    let render = ["render", "ball.ply", "x.png", "--max-memory", &between.to_string()];
    fails(at, &render, &["--max-memory"]);
    for name in ["ball.e57", "ball.las"] {
        let whole = std::fs::read(at.join(name)).unwrap();
        for at_byte in (30..whole.len().min(3000)).step_by(97) {
            let mut damaged = whole.clone();
            damaged[at_byte] ^= 0x5a;
            std::fs::write(at.join("damaged"), damaged).unwrap();
            let output = b2p(at, &["info", "damaged"]);
            let errors = String::from_utf8_lossy(&output.stderr).into_owned();
            assert!(!errors.contains("panicked"), "{name} at {at_byte}: {errors}");
        }
    }
}
