//! Cameras from files: NeRF's `transforms.json`, COLMAP's `cameras.txt` with `images.txt`, Open3D's pinhole cameras,
//! and the camera nodes of glTF.
//!
//! Both speak of the world; the cube that the Gaussians refer to says where it is.

mod colmap;
mod gltf;
mod open3d;

use glam::{DAffine3, DMat3, DVec3};
use serde::Deserialize;
use serde_json::Value;

use super::{Camera, Projection};
use crate::error::{Error, Result};
use crate::gaussians::Frame;

/// Cameras of one file at most.
pub const MAX_CAMERAS: usize = 100_000;

pub use colmap::colmap;

/// A camera and the name of the picture that was taken with it.
pub type Named = (String, Camera);

#[derive(Deserialize)]
struct Transforms {
    camera_angle_x: Option<f64>,
    #[serde(flatten)]
    lens: Lens,
    frames: Vec<Shot>,
}

#[derive(Deserialize)]
struct Shot {
    #[serde(default)]
    file_path: String,
    #[serde(flatten)]
    lens: Lens,
    transform_matrix: [[f64; 4]; 4],
}

#[derive(Deserialize, Clone, Copy)]
struct Lens {
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    w: Option<f64>,
    h: Option<f64>,
}

impl Lens {
    fn or(self, other: Lens) -> Lens {
        Lens {
            fl_x: self.fl_x.or(other.fl_x),
            fl_y: self.fl_y.or(other.fl_y),
            cx: self.cx.or(other.cx),
            cy: self.cy.or(other.cy),
            w: self.w.or(other.w),
            h: self.h.or(other.h),
        }
    }
}

impl Camera {
    /// The cameras of a file, with the names of their pictures: NeRF's `transforms.json`, Open3D's JSON, or glTF.
    /// `frame` is that of the Gaussians; `size` is for files without one.
    ///
    /// # Errors
    /// [`Error::Usage`] if the file is none of these, or one of its cameras is invalid ([`Camera::check`]).
    pub fn from_file(bytes: &[u8], frame: &Frame, size: (u32, u32)) -> Result<Vec<(String, Camera)>> {
        read(bytes, frame, size)
    }
}

/// The cameras of a file that is no text of COLMAP's, told apart by what it holds: binary or JSON glTF, Open3D's JSON,
/// NeRF's. `size` is for files that name none.
///
/// # Errors
/// [`Error::Usage`] if it is none of these, one of its cameras is none ([`Camera::check`]), or there are over
/// [`MAX_CAMERAS`].
pub fn read(bytes: &[u8], frame: &Frame, size: (u32, u32)) -> Result<Vec<Named>> {
    let text = match bytes.starts_with(gltf::MAGIC) {
        true => gltf::json_of(bytes)?,
        false => bytes,
    };
    let value: Value = serde_json::from_slice(text).map_err(|e| Error::Usage(format!("no file of cameras: {e}")))?;
    let has = |name: &str| value.get(name).is_some();
    if has("asset") {
        gltf::cameras(value, frame, size)
    } else if has("frames") {
        nerf(value, frame, size)
    } else if has("intrinsic") || has("parameters") {
        open3d::cameras(value, frame)
    } else {
        let what =
            "no file of cameras: neither `frames` (NeRF), nor `intrinsic` or `parameters` (Open3D), nor `asset` (glTF)";
        Err(Error::Usage(what.into()))
    }
}

/// What `value` describes, or what is wrong with it.
fn parsed<T: serde::de::DeserializeOwned>(what: &str, value: Value) -> Result<T> {
    serde_json::from_value(value).map_err(|e| Error::Usage(format!("{what}: {e}")))
}

/// The cameras of a `transforms.json`: OpenGL axes, from the camera to the world.
fn nerf(file: Value, frame: &Frame, size: (u32, u32)) -> Result<Vec<Named>> {
    let file: Transforms = parsed("transforms.json", file)?;
    let camera = |shot: &Shot| {
        let lens = shot.lens.or(file.lens);
        let side = |given: Option<f64>, otherwise: u32| given.map_or(otherwise, |side| side as u32);
        let (width, height) = (side(lens.w, size.0), side(lens.h, size.1));
        let wide = file.camera_angle_x;
        if let Some(angle) = wide
            && !is_angle(angle)
        {
            return Err(no_angle("transforms.json", "camera_angle_x", angle));
        }
        let wide = wide.map(|angle| f64::from(width) / 2.0 / (angle / 2.0).tan());
        let Some(fx) = lens.fl_x.or(lens.fl_y).or(wide) else {
            return Err(Error::Usage(format!(
                "transforms.json: {}: neither camera_angle_x nor fl_x",
                shot.file_path
            )));
        };
        let m = shot.transform_matrix;
        let column = |k: usize| DVec3::new(m[0][k], m[1][k], m[2][k]);
        let rows = DMat3::from_cols(column(0), -column(1), -column(2));
        let rotation = rows.transpose();
        let named = Camera {
            pose: pose(rotation, -(rotation * column(3)), frame),
            fx,
            fy: lens.fl_y.unwrap_or(fx),
            cx: lens.cx.unwrap_or(f64::from(width) / 2.0),
            cy: lens.cy.unwrap_or(f64::from(height) / 2.0),
            width,
            height,
            near: Camera::NEAR,
            projection: Projection::Pinhole,
            crop: None,
        };
        checked(&shot.file_path, named)
    };
    check_count("transforms.json", file.frames.len())?;
    file.frames.iter().map(camera).collect()
}

/// Fails if a file has more cameras than are taken.
fn check_count(file: &str, count: usize) -> Result<()> {
    if count <= MAX_CAMERAS {
        return Ok(());
    }
    Err(Error::Usage(format!(
        "{file}: there are {count} cameras, {MAX_CAMERAS} are taken at most"
    )))
}

/// Whether a pinhole can see so much, in radians.
fn is_angle(angle: f64) -> bool {
    angle > 0.0 && angle < std::f64::consts::PI
}

fn no_angle(name: &str, field: &str, angle: f64) -> Error {
    Error::Usage(format!(
        "{name}: {field} is {angle}, it must be between 0 and π (half a turn)"
    ))
}

/// From the cube to the camera, in cube-frame units, of what is from the world to the camera in the world's.
fn pose(rotation: DMat3, translation: DVec3, frame: &Frame) -> DAffine3 {
    let unit = frame.unit();
    let middle = DVec3::from(frame.placement.origin) + unit;
    DAffine3::from_mat3_translation(rotation, (rotation * middle + translation) / unit)
}

fn checked(name: &str, camera: Camera) -> Result<Named> {
    camera.check().map_err(|e| Error::Usage(format!("{name}: {e}")))?;
    Ok((name.to_owned(), camera))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::placement::Placement;

    const FRAME: Frame = Frame {
        bits: 4,
        placement: Placement {
            origin: [1.0, 2.0, 3.0],
            voxel_size: 0.5,
        },
    };

    /// What both files below describe: from 10 to the front of the cube's middle, which is at (5, 6, 7).
    fn assert_is_the_orbit(camera: &Camera) {
        let expected = Camera::orbit(0.0, 0.0, 2.5, 90.0, 80, 60).unwrap();
        assert_eq!((camera.width, camera.height), (80, 60));
        assert!((camera.fx - expected.fx).abs() < 1e-9 && camera.fy == camera.fx);
        for point in [[0.0, 0.0, 0.0], [0.5, -0.25, 1.0]] {
            let [a, b] = [camera, &expected].map(|c| c.pose.transform_point3(point.into()));
            assert!((a - b).length() < 1e-9, "{a} {b}");
        }
    }

    #[test]
    fn files_of_every_kind_that_describe_the_same_view_agree() {
        let json = r#"{"camera_angle_x": 1.5707963267948966, "w": 80, "h": 60, "frames": [
            {"file_path": "a.png", "transform_matrix":
             [[1, 0, 0, 5], [0, 1, 0, 6], [0, 0, 1, 17], [0, 0, 0, 1]]}]}"#;
        let named = read(json.as_bytes(), &FRAME, (1, 1)).unwrap();
        assert_eq!((named.len(), named[0].0.as_str()), (1, "a.png"));
        assert_is_the_orbit(&named[0].1);

        // Half a turn around x: x stays, y and z turn round.
        let cameras = "# none\n7 SIMPLE_PINHOLE 80 60 40 40 30\n";
        let images = "# none\n1 0 1 0 0 -5 6 17 7 b.png\n\n2 0 1 0 0 -5 6 17 7 c.png\n1 2 3\n";
        let named = colmap(cameras, images, &FRAME).unwrap();
        assert_eq!(named.len(), 2);
        assert_is_the_orbit(&named[1].1);

        // Column by column; the middle of the first pixel is 0.
        let open3d = r#"{"class_name": "PinholeCameraParameters",
            "extrinsic": [1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1, 0, -5, 6, 17, 1],
            "intrinsic": {"width": 80, "height": 60, "intrinsic_matrix": [40, 0, 0, 0, 40, 0, 39.5, 29.5, 1]}}"#;
        let many = format!(r#"{{"class_name": "PinholeCameraTrajectory", "parameters": [{open3d}, {open3d}]}}"#);
        for (file, count) in [(open3d, 1), (many.as_str(), 2)] {
            let named = read(file.as_bytes(), &FRAME, (1, 1)).unwrap();
            assert_eq!(named.len(), count);
            assert_is_the_orbit(&named[count - 1].1);
        }

        // Half the height over the distance is the tangent of half the angle: 30/40. The parent lifts what its child
        // moves back.
        let gltf = r#"{"asset": {"version": "2.0"},
            "cameras": [{"type": "perspective", "perspective": {"yfov": 1.2870022175866872, "znear": 0.04}}],
            "nodes": [{"translation": [5, 6, 7], "scale": [2, 2, 2], "children": [1]},
                      {"name": "eye", "camera": 0, "translation": [0, 0, 5]}]}"#;
        let mut binary = b"glTF\x02\0\0\0".to_vec();
        binary.extend((20 + gltf.len() as u32).to_le_bytes());
        binary.extend((gltf.len() as u32).to_le_bytes());
        binary.extend(b"JSON");
        binary.extend(gltf.as_bytes());
        for file in [gltf.as_bytes(), &binary] {
            let named = read(file, &FRAME, (80, 60)).unwrap();
            assert_eq!((named.len(), named[0].0.as_str()), (1, "eye"));
            assert_is_the_orbit(&named[0].1);
            assert!((named[0].1.near - 0.01).abs() < 1e-12);
        }
        for cut in 0..binary.len() {
            assert!(read(&binary[..cut], &FRAME, (80, 60)).is_err(), "{cut}");
        }
    }

    #[test]
    fn an_orthographic_node_shows_as_much_as_it_says_and_circles_of_nodes_are_refused() {
        let file = |nodes: &str| {
            format!(
                r#"{{"asset": {{"version": "2.0"}}, "nodes": {nodes}, "cameras": [
                {{"type": "orthographic", "orthographic": {{"xmag": 8, "ymag": 6, "znear": 0, "zfar": 9}}}}]}}"#
            )
        };
        let named = read(file(r#"[{"camera": 0}]"#).as_bytes(), &FRAME, (80, 60)).unwrap();
        let camera = named[0].1;
        assert_eq!(camera.projection, Projection::Orthographic);
        // 80 pixels are 16 of the world's units, and 4 of the cube's.
        assert!((camera.fx - 20.0).abs() < 1e-9 && (camera.fy - 20.0).abs() < 1e-9);
        for nodes in [
            r#"[{"camera": 0, "children": [1]}, {"children": [0]}]"#,
            r#"[{"camera": 1}]"#,
            r#"[{"camera": 0, "children": [7]}]"#,
            r#"[{"camera": 0, "scale": [1, -1, 1]}]"#,
        ] {
            assert!(read(file(nodes).as_bytes(), &FRAME, (8, 8)).is_err(), "{nodes}");
        }
    }

    #[test]
    fn what_is_no_camera_is_an_error_that_names_it() {
        let json = |m: &str| format!(r#"{{"fl_x": 50, "frames": [{{"file_path": "a", "transform_matrix": {m}}}]}}"#);
        for matrix in [
            "[[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]",
            "[[1, 1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]",
            "[[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]]",
            "[[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]",
        ] {
            let error = read(json(matrix).as_bytes(), &FRAME, (8, 8)).unwrap_err().to_string();
            assert!(error.contains("a: "), "{error}");
        }
        assert!(read(b"{}", &FRAME, (8, 8)).is_err());
        assert!(read(br#"{"frames": []}"#, &FRAME, (8, 8)).unwrap().is_empty());
        let fish = colmap("1 OPENCV_FISHEYE 8 8 1 1 1 1\n", "1 1 0 0 0 0 0 0 1 a\n", &FRAME);
        assert!(matches!(fish, Err(Error::Unsupported { .. })));
        assert!(colmap("", "1 1 0 0 0 0 0 0 1 a\n", &FRAME).is_err());
        assert!(colmap("1 PINHOLE 8 8 1 1 1 1\n", "1 x 0 0 0 0 0 0 1 a\n", &FRAME).is_err());
    }

    #[test]
    fn lenses_of_gltf_that_see_nothing_or_all_around_are_refused() {
        let file = |lens: &str| {
            format!(r#"{{"asset": {{}}, "nodes": [{{"name": "eye", "camera": 0}}], "cameras": [{lens}]}}"#)
        };
        let perspective = |yfov: &str, znear: &str| {
            file(&format!(
                r#"{{"type": "perspective", "perspective": {{"yfov": {yfov}, "znear": {znear}}}}}"#
            ))
        };
        assert!(read(perspective("1", "0.1").as_bytes(), &FRAME, (8, 8)).is_ok());
        for (yfov, znear, field) in [
            ("1e9", "0.1", "yfov"),
            ("3.15", "0.1", "yfov"),
            ("0", "0.1", "yfov"),
            ("-1", "0.1", "yfov"),
            ("1", "-0.1", "znear"),
        ] {
            let error = read(perspective(yfov, znear).as_bytes(), &FRAME, (8, 8))
                .unwrap_err()
                .to_string();
            assert!(error.contains("eye") && error.contains(field), "{error}");
        }
        let flat = file(r#"{"type": "orthographic", "orthographic": {"xmag": 1, "ymag": 1, "znear": -1, "zfar": 9}}"#);
        assert!(read(flat.as_bytes(), &FRAME, (8, 8)).is_err());
        let nerf = r#"{"camera_angle_x": 4, "frames": [{"transform_matrix":
            [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}]}"#;
        let error = read(nerf.as_bytes(), &FRAME, (8, 8)).unwrap_err().to_string();
        assert!(error.contains("camera_angle_x is 4"), "{error}");
    }

    #[test]
    fn a_file_of_more_cameras_than_are_taken_is_refused_whatever_its_kind() {
        let many = MAX_CAMERAS + 1;
        let shot = r#"{"transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}"#;
        let nerf = format!(r#"{{"fl_x": 9, "frames": [{}]}}"#, vec![shot; many].join(","));
        let lens = r#"{"type": "perspective", "perspective": {"yfov": 1, "znear": 1}}"#;
        let nodes = vec![r#"{"camera": 0}"#; many].join(",");
        let gltf = format!(r#"{{"asset": {{}}, "cameras": [{lens}], "nodes": [{nodes}]}}"#);
        for file in [nerf, gltf] {
            let error = read(file.as_bytes(), &FRAME, (8, 8)).unwrap_err().to_string();
            assert!(error.contains("100000 are taken"), "{error}");
        }
        let images = "1 1 0 0 0 0 0 0 7 a\n\n".repeat(many);
        let lenses: String = (0..many).map(|i| format!("{i} SIMPLE_PINHOLE 8 8 9 4 4\n")).collect();
        let error = colmap(&lenses, &images, &FRAME).unwrap_err().to_string();
        assert!(error.contains("100000 are taken"), "{error}");
    }

    #[test]
    fn a_camera_below_very_many_nodes_is_refused_at_once() {
        let count = 50_000;
        let below = (1..count).map(|i| format!(r#"{{"children": [{i}], "camera": 0}}"#));
        let nodes: Vec<String> = below.collect();
        let lens = r#"{"type": "perspective", "perspective": {"yfov": 1, "znear": 1}}"#;
        let file = format!(
            r#"{{"asset": {{}}, "cameras": [{lens}], "nodes": [{}, {{}}]}}"#,
            nodes.join(",")
        );
        let error = read(file.as_bytes(), &FRAME, (8, 8)).unwrap_err().to_string();
        assert!(error.contains("below more than 1000 nodes"), "{error}");
    }
}
