//! Where the cameras of a picture stand.

use std::path::{Path, PathBuf};

use b2p::axes::Up;
use b2p::gaussians::Frame;
use b2p::renderer::camera::{Camera, Extent, Projection, files};
use b2p::{Axes, Limits};

use super::args::Render;
use super::{Failure, Result, cloud, load};

/// Pictures of a contact sheet and of a turntable, unless a number is given.
const ON_SHEET: u32 = 8;
const OF_TURNTABLE: u32 = 120;
/// A file of cameras takes so much more memory once it is read.
const CAMERA_FILE_SHARE: u64 = 32;

/// A camera, the file that its picture goes to, and what it is called.
pub struct Shot {
    pub path: PathBuf,
    pub camera: Camera,
    pub label: String,
}

/// How many pictures are drawn, where they are on a circle.
fn count(args: &Render) -> u32 {
    let usual = match (args.contact_sheet, &args.turntable) {
        (true, _) => ON_SHEET,
        (_, Some(_)) => OF_TURNTABLE,
        _ => 1,
    };
    args.view.views.unwrap_or(usual)
}

/// The second file of cameras of COLMAP.
pub fn lenses_beside(cameras: &Path) -> Option<PathBuf> {
    let is_colmap = cameras.extension().is_some_and(|ending| ending == "txt");
    is_colmap.then(|| cameras.with_file_name("cameras.txt"))
}

/// The cameras of the file, or of the circle around an object that takes `extent` of the cube, upright as far as `axes`
/// say what that is.
pub fn shots(args: &Render, frame: &Frame, extent: &Extent, axes: &Axes, limits: &Limits) -> Result<Vec<Shot>> {
    let named = match &args.camera {
        Some(path) => from_file(path, args.view.size, frame, limits)?,
        None => circle(args, frame, extent, cloud::up_of(args.up, axes))?,
    };
    let one_file = args.contact_sheet || args.turntable.is_some() || named.len() == 1;
    let path = |i: usize| match one_file {
        true => args.output.to_path_buf(),
        false => numbered(&args.output, i),
    };
    let shots = named.into_iter().enumerate().map(|(i, (label, camera))| Shot {
        path: path(i),
        camera,
        label,
    });
    Ok(shots.collect())
}

/// The cameras of a file, with their names.
fn from_file(path: &Path, size: (u32, u32), frame: &Frame, limits: &Limits) -> Result<Vec<files::Named>> {
    let limits = limits.clone().with_max_bytes(limits.max_bytes / CAMERA_FILE_SHARE);
    let text = |path: &Path| -> Result<String> {
        let text = String::from_utf8(load::bytes(path, &limits)?);
        text.map_err(|_| Failure(format!("{}: not a text", path.display())))
    };
    let named = if let Some(lenses) = lenses_beside(path) {
        files::colmap(&text(&lenses)?, &text(path)?, frame)
    } else {
        files::read(&load::bytes(path, &limits)?, frame, size)
    };
    let named = named.map_err(Failure::in_file(path))?;
    match named.is_empty() {
        true => Err(Failure(format!("{}: no cameras", path.display()))),
        false => Ok(named),
    }
}

/// The cameras of a circle, each called by its azimuth.
fn circle(args: &Render, frame: &Frame, extent: &Extent, up: Option<Up>) -> Result<Vec<files::Named>> {
    let view = &args.view;
    let count = count(args);
    let azimuths = (0..count).map(|i| view.orbit.azimuth + 360.0 * f64::from(i) / f64::from(count));
    let target = target(view.look_at, view.orbit.distance, frame, extent);
    let at = |azimuth: f64, radius: f64| {
        let (width, height) = view.size;
        let (elevation, fov) = (view.orbit.elevation, view.fov.into());
        let camera = Camera::orbit_around(target, azimuth, elevation, radius, fov, width, height);
        camera.map(|camera| up.map_or(camera, |up| camera.with_up(up, target)))
    };
    let projection = match args.orthographic {
        true => Projection::Orthographic,
        false => Projection::Pinhole,
    };
    // The same for all, so that the object does not swell and shrink as it turns.
    let radius = match view.orbit.distance {
        Some(radius) => radius,
        None => {
            let mut radius = 0.0f64;
            for azimuth in azimuths.clone() {
                radius = radius.max(at(azimuth, 3.0)?.radius_for(extent, target, projection));
            }
            radius
        }
    };
    let camera = |azimuth: f64| {
        let camera = at(azimuth, radius)?;
        let camera = match args.orthographic {
            true => {
                // Parallel rays see what is behind the camera's place no more than a pinhole does: it stands outside
                // the cube.
                let mut far = at(azimuth, radius.max(4.0))?;
                far.fx = camera.fx / radius;
                far.fy = far.fx;
                far.projection = projection;
                far
            }
            false => camera,
        };
        camera.check()?;
        Ok((label(azimuth, view.orbit.elevation), camera))
    };
    azimuths.map(camera).collect()
}

/// The point that is looked at, in the cube frame: `look_at`, which is in the units of the cloud, or the middle of the
/// object, or with a distance that of the cube.
pub fn target(look_at: Option<[f64; 3]>, distance: Option<f64>, frame: &Frame, extent: &Extent) -> [f64; 3] {
    match (look_at, distance) {
        (Some(world), _) => {
            let unit = frame.unit();
            std::array::from_fn(|axis| (world[axis] - frame.placement.origin[axis]) / unit - 1.0)
        }
        (None, Some(_)) => [0.0; 3],
        (None, None) => extent.middle(),
    }
}

fn label(azimuth: f64, elevation: f64) -> String {
    let azimuth = (azimuth.rem_euclid(360.0) * 10.0).round() / 10.0;
    match elevation == 0.0 {
        true => format!("{azimuth}°"),
        false => format!("{azimuth}°, {elevation}°"),
    }
}

/// `path` with a number before its ending.
fn numbered(path: &Path, i: usize) -> PathBuf {
    let mut name = path.file_stem().unwrap_or_default().to_owned();
    name.push(format!("-{i:03}"));
    if let Some(ending) = path.extension() {
        name.push(".");
        name.push(ending);
    }
    path.with_file_name(name)
}
