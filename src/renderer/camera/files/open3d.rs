//! Open3D's `PinholeCameraParameters` and `PinholeCameraTrajectory`.

use glam::{DMat3, DMat4, DVec3};
use serde::Deserialize;
use serde_json::Value;

use super::{Named, check_count, checked, parsed, pose};
use crate::error::Result;
use crate::gaussians::Frame;
use crate::renderer::camera::{Camera, Projection};

#[derive(Deserialize)]
struct Trajectory {
    parameters: Vec<Parameters>,
}

/// Matrices column by column; the extrinsic one is from the world to the camera: x right, y down, z forward.
#[derive(Deserialize)]
struct Parameters {
    extrinsic: [f64; 16],
    intrinsic: Intrinsic,
}

#[derive(Deserialize)]
struct Intrinsic {
    width: u32,
    height: u32,
    intrinsic_matrix: [f64; 9],
}

/// The cameras of a file that is one of either.
pub(super) fn cameras(file: Value, frame: &Frame) -> Result<Vec<Named>> {
    let what = "pinhole cameras of Open3D";
    let all = match file.get("parameters") {
        Some(_) => parsed::<Trajectory>(what, file)?.parameters,
        None => vec![parsed(what, file)?],
    };
    check_count(what, all.len())?;
    let camera = |(i, parameters): (usize, &Parameters)| {
        let extrinsic = DMat4::from_cols_array(&parameters.extrinsic);
        let rotation = DMat3::from_mat4(extrinsic);
        let translation: DVec3 = extrinsic.w_axis.truncate();
        let [fx, _, _, _, fy, _, cx, cy, _] = parameters.intrinsic.intrinsic_matrix;
        let camera = Camera {
            pose: pose(rotation, translation, frame),
            fx,
            fy,
            // Open3D counts from the middle of the first pixel, not from its corner.
            cx: cx + 0.5,
            cy: cy + 0.5,
            width: parameters.intrinsic.width,
            height: parameters.intrinsic.height,
            near: Camera::NEAR,
            projection: Projection::Pinhole,
            crop: None,
        };
        checked(&format!("camera {i}"), camera)
    };
    all.iter().enumerate().map(camera).collect()
}
