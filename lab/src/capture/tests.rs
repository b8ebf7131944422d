use glam::Vec3;

use super::*;
use crate::mesh::Mesh;
use crate::mesh::fixtures::{quad, texture};
use crate::procedural::{pattern, shapes};

const KINDS: [Kind; 4] = [Kind::Lidar, Kind::Depth, Kind::Frame, Kind::Photogrammetry];

/// A ball of radius 1.
fn ball() -> Surface {
    let paint = pattern::checker(0.1, Vec3::new(0.9, 0.2, 0.1), Vec3::new(0.1, 0.3, 0.8));
    Surface::new(&Mesh {
        parts: vec![shapes::sphere().part(100.0, &paint, None)],
    })
}

fn of(surface: &Surface, kind: Kind, noise: f64) -> Capture {
    let options = Options {
        kind,
        points: 8_000,
        seed: 4,
        noise,
    };
    capture(surface, &options).unwrap()
}

fn radius(p: &[f64; 3]) -> f64 {
    glam::DVec3::from(*p).length()
}

/// Standard deviation of the distance from the ball's surface.
fn deviation(capture: &Capture) -> f64 {
    let squares = capture.positions.iter().map(|p| (radius(p) - 1.0).powi(2));
    (squares.sum::<f64>() / capture.positions.len() as f64).sqrt()
}

#[test]
fn without_noise_points_lie_on_the_surface_and_with_it_near() {
    let ball = ball();
    for kind in KINDS {
        let exact = of(&ball, kind, 0.0);
        // The mesh is a polyhedron within the ball.
        assert!(
            exact.positions.iter().all(|p| (0.985..1.015).contains(&radius(p))),
            "{kind:?}"
        );
        assert_eq!(exact.positions.len(), exact.rgb.len());
        // Its variance is in the captures with noise, too.
        let added = |noise| {
            let variance = deviation(&of(&ball, kind, noise)).powi(2) - deviation(&exact).powi(2);
            variance.max(0.0).sqrt()
        };
        let noisy = added(1.0);
        assert!((0.0005..0.05).contains(&noisy), "{kind:?}: {noisy}");
        let more = added(3.0);
        // Pixels at edges err as far with little noise.
        assert!(more > 1.2 * noisy, "{kind:?}: {more} after {noisy}");
    }
}

#[test]
fn captures_have_about_the_wanted_number_of_points() {
    let ball = ball();
    for kind in KINDS {
        let count = of(&ball, kind, 1.0).positions.len();
        assert!((4_000..10_000).contains(&count), "{kind:?}: {count}");
    }
}

#[test]
fn equal_seeds_give_equal_captures_for_any_number_of_threads() {
    let ball = ball();
    for kind in KINDS {
        let with = |threads, seed| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let options = Options {
                kind,
                points: 3_000,
                seed,
                noise: 1.0,
            };
            pool.install(|| capture(&ball, &options).unwrap())
        };
        let one = with(1, 7);
        assert_eq!(one, with(3, 7), "{kind:?}");
        assert_ne!(one, with(1, 8), "{kind:?}");
    }
}

#[test]
fn a_frame_sees_one_side_and_the_others_go_around() {
    let ball = ball();
    let hidden = |kind| {
        let capture = of(&ball, kind, 1.0);
        capture.positions.iter().filter(|p| p[2] < -0.2).count()
    };
    assert_eq!(hidden(Kind::Frame), 0);
    for kind in [Kind::Lidar, Kind::Depth, Kind::Photogrammetry] {
        assert!(hidden(kind) > 500, "{kind:?}");
    }
}

#[test]
fn a_laser_returns_less_at_grazing_angles() {
    let ball = ball();
    let share = |noise| {
        let capture = of(&ball, Kind::Lidar, noise);
        // Poles are seen at grazing angles from all places.
        let poles = capture.positions.iter().filter(|p| p[1] < -0.75).count();
        poles as f64 / capture.positions.len() as f64
    };
    assert!(share(1.0) < 0.8 * share(0.0), "{} {}", share(1.0), share(0.0));
}

#[test]
fn depth_cameras_leave_flying_pixels_behind_edges_only() {
    let grey = texture(8, 8, |_, _| [128, 128, 128, 255]);
    let card = quad([-0.5, -0.5, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], Some(grey));
    let capture = of(&Surface::new(&Mesh { parts: vec![card] }), Kind::Frame, 1.0);
    // Farther behind the card than noise explains.
    let flying: Vec<_> = capture.positions.iter().filter(|p| p[2] < -0.03).collect();
    assert!((5..400).contains(&flying.len()), "{}", flying.len());
    for p in flying {
        assert!(p[0].abs().max(p[1].abs()) > 0.4, "{p:?}");
    }
}

#[test]
fn stereo_finds_more_points_where_there_is_texture() {
    // A square, one half of it plain.
    let half = texture(128, 128, |x, y| {
        if x < 64 {
            [128, 128, 128, 255]
        } else {
            [((x + y) % 2 * 200) as u8 + 20; 4]
        }
    });
    let opaque = crate::mesh::Texture {
        rgba: half.rgba.iter().map(|p| [p[0], p[1], p[2], 255]).collect(),
        ..half
    };
    let square = quad([-0.5, -0.5, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], Some(opaque));
    let capture = of(&Surface::new(&Mesh { parts: vec![square] }), Kind::Photogrammetry, 1.0);
    let plain = capture.positions.iter().filter(|p| p[0] < 0.0).count();
    assert!(3 * plain < capture.positions.len(), "{plain}");
}

#[test]
fn photographs_leave_seams_between_views() {
    // A grey ball: without seams and blocks, all colours would be alike.
    let paint = pattern::plain(Vec3::splat(0.5));
    let grey = Surface::new(&Mesh {
        parts: vec![shapes::sphere().part(50.0, &paint, None)],
    });
    let capture = of(&grey, Kind::Depth, 0.0);
    let reds = || capture.rgb.iter().map(|c| c[0]);
    let (least, most) = (reds().min().unwrap(), reds().max().unwrap());
    assert!(most - least > 8 && most - least < 60, "{least} {most}");
}

#[test]
fn a_written_capture_is_read_as_the_same_points() {
    let capture = of(&ball(), Kind::Lidar, 1.0);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("capture.ply");
    capture.write_ply(&path).unwrap();
    let read = b2p::cloud::PointCloud::open(&path, &b2p::Limits::default()).unwrap();
    assert_eq!(read.colours, capture.rgb);
    let single = |p: &[f64; 3]| p.map(|v| f64::from(v as f32));
    assert!(
        read.positions
            .iter()
            .eq(capture.positions.iter().map(single).collect::<Vec<_>>().iter())
    );
}
