//! Cameras from files: NeRF's `transforms.json`, and COLMAP's `cameras.txt` with `images.txt`.
//!
//! Both speak of the world; the cube that the Gaussians refer to says where it is.

use glam::{DAffine3, DMat3, DQuat, DVec3};
use serde::Deserialize;

use super::{Camera, Projection};
use crate::error::{Error, Result};
use crate::gaussians::Frame;

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

/// The cameras of a `transforms.json`: OpenGL axes, from the camera to the world. `size` is for files that name none.
///
/// # Errors
/// [`Error::Usage`] if it is not such a file, or one of them is no camera ([`Camera::check`]).
pub fn nerf(text: &str, frame: &Frame, size: (u32, u32)) -> Result<Vec<Named>> {
    let file: Transforms =
        serde_json::from_str(text).map_err(|e| Error::Usage(format!("transforms.json: {e}")))?;
    let camera = |shot: &Shot| {
        let lens = shot.lens.or(file.lens);
        let side = |given: Option<f64>, otherwise: u32| given.map_or(otherwise, |side| side as u32);
        let (width, height) = (side(lens.w, size.0), side(lens.h, size.1));
        let wide = file.camera_angle_x;
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
        };
        checked(&shot.file_path, named)
    };
    file.frames.iter().map(camera).collect()
}

/// The cameras of COLMAP's text files, in the order of the images.
///
/// # Errors
/// [`Error::Usage`] if a line cannot be understood, a lens distorts, or one of them is no camera.
pub fn colmap(cameras: &str, images: &str, frame: &Frame) -> Result<Vec<Named>> {
    let bad = |file: &str, line: &str| Error::Usage(format!("{file}: cannot read `{line}`"));
    let lens = |id: &str| -> Result<Camera> {
        let words = cameras.lines().map(|l| l.split_whitespace());
        let mut words = words.filter(|w| w.clone().next() == Some(id));
        let line: Vec<&str> = words
            .next()
            .ok_or_else(|| Error::Usage(format!("cameras.txt: no camera {id}")))?
            .collect();
        let numbers: Option<Vec<f64>> = line.iter().skip(2).map(|w| w.parse().ok()).collect();
        let numbers = numbers.ok_or_else(|| bad("cameras.txt", &line.join(" ")))?;
        let (fx, fy, cx, cy, width, height) = match (line.get(1).copied(), &numbers[..]) {
            (Some("SIMPLE_PINHOLE"), &[w, h, f, cx, cy]) => (f, f, cx, cy, w, h),
            (Some("PINHOLE"), &[w, h, fx, fy, cx, cy]) => (fx, fy, cx, cy, w, h),
            (Some("SIMPLE_PINHOLE" | "PINHOLE"), _) => {
                return Err(bad("cameras.txt", &line.join(" ")));
            }
            (model, _) => {
                return Err(Error::Unsupported {
                    what: "a camera that is no pinhole",
                    detail: format!(
                        "camera {id} of cameras.txt is a {}; undistort the images first",
                        model.unwrap_or("nameless one")
                    ),
                });
            }
        };
        Ok(Camera {
            pose: DAffine3::IDENTITY,
            fx,
            fy,
            cx,
            cy,
            width: width as u32,
            height: height as u32,
            near: Camera::NEAR,
            projection: Projection::Pinhole,
        })
    };
    // Every other line lists the image's points, and may be empty.
    let mut named = Vec::new();
    let mut lines = images.lines().filter(|l| !l.starts_with('#'));
    while let Some(line) = lines.next() {
        if line.trim().is_empty() {
            continue;
        }
        let words: Vec<&str> = line.split_whitespace().collect();
        let [_, numbers @ .., id, name] = &words[..] else {
            return Err(bad("images.txt", line));
        };
        let numbers: Option<Vec<f64>> = numbers.iter().map(|w| w.parse().ok()).collect();
        let Some([w, x, y, z, tx, ty, tz]) = numbers.and_then(|n| <[f64; 7]>::try_from(n).ok())
        else {
            return Err(bad("images.txt", line));
        };
        let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
        let mut camera = lens(id)?;
        camera.pose = pose(rotation, DVec3::new(tx, ty, tz), frame);
        named.push(checked(name, camera)?);
        lines.next();
    }
    Ok(named)
}

/// From the cube to the camera, in cube-frame units, of what is from the world to the camera in the world's.
fn pose(rotation: DMat3, translation: DVec3, frame: &Frame) -> DAffine3 {
    let unit = frame.unit();
    let middle = DVec3::from(frame.placement.origin) + unit;
    DAffine3::from_mat3_translation(rotation, (rotation * middle + translation) / unit)
}

fn checked(name: &str, camera: Camera) -> Result<Named> {
    camera
        .check()
        .map_err(|e| Error::Usage(format!("{name}: {e}")))?;
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
    fn a_nerf_file_and_a_colmap_file_of_the_same_view_agree() {
        let json = r#"{"camera_angle_x": 1.5707963267948966, "w": 80, "h": 60, "frames": [
            {"file_path": "a.png", "transform_matrix":
             [[1, 0, 0, 5], [0, 1, 0, 6], [0, 0, 1, 17], [0, 0, 0, 1]]}]}"#;
        let named = nerf(json, &FRAME, (1, 1)).unwrap();
        assert_eq!((named.len(), named[0].0.as_str()), (1, "a.png"));
        assert_is_the_orbit(&named[0].1);

        // Half a turn around x: x stays, y and z turn round.
        let cameras = "# none\n7 SIMPLE_PINHOLE 80 60 40 40 30\n";
        let images = "# none\n1 0 1 0 0 -5 6 17 7 b.png\n\n2 0 1 0 0 -5 6 17 7 c.png\n1 2 3\n";
        let named = colmap(cameras, images, &FRAME).unwrap();
        assert_eq!(named.len(), 2);
        assert_is_the_orbit(&named[1].1);
    }

    #[test]
    fn what_is_no_camera_is_an_error_that_names_it() {
        let json = |m: &str| {
            format!(r#"{{"fl_x": 50, "frames": [{{"file_path": "a", "transform_matrix": {m}}}]}}"#)
        };
        for matrix in [
            "[[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]",
            "[[1, 1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]",
            "[[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]]",
            "[[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]",
        ] {
            let error = nerf(&json(matrix), &FRAME, (8, 8)).unwrap_err().to_string();
            assert!(error.contains("a: "), "{error}");
        }
        assert!(nerf("{}", &FRAME, (8, 8)).is_err());
        assert!(
            nerf(r#"{"frames": []}"#, &FRAME, (8, 8))
                .unwrap()
                .is_empty()
        );
        let fish = colmap(
            "1 OPENCV_FISHEYE 8 8 1 1 1 1\n",
            "1 1 0 0 0 0 0 0 1 a\n",
            &FRAME,
        );
        assert!(matches!(fish, Err(Error::Unsupported { .. })));
        assert!(colmap("", "1 1 0 0 0 0 0 0 1 a\n", &FRAME).is_err());
        assert!(colmap("1 PINHOLE 8 8 1 1 1 1\n", "1 x 0 0 0 0 0 0 1 a\n", &FRAME).is_err());
    }
}
