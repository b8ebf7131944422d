//! COLMAP's text files.

use std::collections::HashMap;

use glam::{DAffine3, DMat3, DQuat, DVec3};

use super::{Named, check_count, checked, pose};
use crate::error::{Error, Result};
use crate::gaussians::Frame;
use crate::renderer::camera::{Camera, Projection};

/// The cameras of COLMAP's text files, in the order of the images.
///
/// # Errors
/// [`Error::Usage`] if a line cannot be understood, a lens distorts, one of them is no camera, or there are over
/// [`MAX_CAMERAS`](super::MAX_CAMERAS).
pub fn colmap(cameras: &str, images: &str, frame: &Frame) -> Result<Vec<Named>> {
    let bad = |file: &str, line: &str| Error::Usage(format!("{file}: cannot read `{line}`"));
    let mut lenses = HashMap::new();
    for line in cameras.lines() {
        if let Some(id) = line.split_whitespace().next() {
            lenses.entry(id).or_insert(line);
        }
    }
    let lens = |id: &str| -> Result<Camera> {
        let line = lenses.get(id);
        let line = line.ok_or_else(|| Error::Usage(format!("cameras.txt: no camera {id}")))?;
        let line: Vec<&str> = line.split_whitespace().collect();
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
            crop: None,
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
        let Some([w, x, y, z, tx, ty, tz]) = numbers.and_then(|n| <[f64; 7]>::try_from(n).ok()) else {
            return Err(bad("images.txt", line));
        };
        let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
        let mut camera = lens(id)?;
        camera.pose = pose(rotation, DVec3::new(tx, ty, tz), frame);
        named.push(checked(name, camera)?);
        check_count("images.txt", named.len())?;
        lines.next();
    }
    Ok(named)
}
