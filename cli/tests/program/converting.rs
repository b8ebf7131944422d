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
        &["ball.ply", "not Gaussians", "b2p encode"],
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
