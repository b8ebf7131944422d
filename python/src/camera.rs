//! Cameras, which become those of the renderer once Gaussians and size of the picture are known.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use b2p::gaussians::Frame;
use b2p::renderer::camera::files::{self, Named};
use b2p::{Camera, Error, Extent, Projection, Result, Up, input};
use pyo3::prelude::*;

use crate::arrays::{as_array, check, flat};
use crate::errors;
use crate::values::{self, PyLimits};

/// Bytes of a file of cameras take so much more memory once it is read.
const FILE_SHARE: u64 = 32;
/// The size of pictures unless one is given.
const SIZE: (u32, u32) = (1024, 1024);
/// The horizontal field of view of orbits unless one is given, in degrees.
const FOV: f64 = 45.0;

/// Where a picture is taken from: `Camera.orbit`, `Camera.from_matrix`, `Camera.load`.
#[pyclass(frozen, module = "b2p", name = "Camera", from_py_object)]
#[derive(Clone)]
pub struct PyCamera {
    view: View,
    name: String,
}

#[derive(Clone)]
enum View {
    Orbit(Orbit),
    Matrix(Matrix),
    File { file: Arc<File>, index: usize },
}

/// Around an object.
#[derive(Clone)]
struct Orbit {
    azimuth: f64,
    elevation: f64,
    distance: Option<f64>,
    fov: f64,
    look_at: Option<[f64; 3]>,
    up: Option<Up>,
    orthographic: bool,
}

/// From the world to camera axes x right, y down, z forward.
#[derive(Clone)]
struct Matrix {
    rotation: [[f64; 3]; 3],
    translation: [f64; 3],
    lens: Lens,
    size: Option<(u32, u32)>,
    near: Option<f64>,
}

#[derive(Clone)]
enum Lens {
    /// Horizontal, in degrees.
    Fov(f64),
    /// fx, fy, cx, cy in pixels.
    Intrinsics([f64; 4]),
}

/// A file of cameras. They depend on the cube, and are kept for the last one.
struct File {
    text: Text,
    last: Mutex<Option<Resolved>>,
}

/// The cameras of a file for a cube and a size.
struct Resolved {
    frame: Frame,
    size: (u32, u32),
    named: Vec<Named>,
}

enum Text {
    Any(Vec<u8>),
    Colmap { cameras: String, images: String },
}

impl File {
    fn open(path: &Path, limits: &b2p::Limits) -> Result<Self> {
        let limits = limits.clone().with_max_bytes(limits.max_bytes / FILE_SHARE);
        let read = |path: &Path| input::read_file(path, &limits);
        let text = |path: &Path| {
            let text = String::from_utf8(read(path)?);
            text.map_err(|_| Error::Usage(format!("{}: not a text", path.display())))
        };
        let text = match path.extension().is_some_and(|ending| ending == "txt") {
            true => Text::Colmap {
                cameras: text(&path.with_file_name("cameras.txt"))?,
                images: text(path)?,
            },
            false => Text::Any(read(path)?),
        };
        let last = Mutex::new(None);
        Ok(File { text, last })
    }

    /// The camera number `index`, or the names of all.
    fn with<T>(&self, frame: &Frame, size: (u32, u32), take: impl FnOnce(&[Named]) -> T) -> Result<T> {
        let mut last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        let known = last
            .as_ref()
            .is_some_and(|last| last.frame == *frame && last.size == size);
        if !known {
            let named = match &self.text {
                Text::Any(bytes) => files::read(bytes, frame, size)?,
                Text::Colmap { cameras, images } => files::colmap(cameras, images, frame)?,
            };
            let frame = *frame;
            *last = Some(Resolved { frame, size, named });
        }
        Ok(take(last.as_ref().map_or(&[], |last| &last.named)))
    }
}

#[pymethods]
impl PyCamera {
    /// A camera on a sphere around an object, looking at it.
    ///
    /// Parameters
    /// ----------
    /// azimuth, elevation : float
    ///     Degrees. At azimuth 0 the camera is in front, at z > 0 of objects whose y axis points up.
    /// distance : float, optional
    ///     Distance from what is looked at, in cube-frame units, half sides of the cube. By default the whole object is
    ///     in view.
    /// fov : float
    ///     Horizontal field of view in degrees.
    /// look_at : (float, float, float), optional
    ///     Point to look at, in the world. By default the middle of the object; with a distance, the cube's.
    /// up : {"x", "-x", "y", "-y", "z", "-z"}, optional
    ///     The axis that points up in the picture. By default what the stream says, else y.
    /// orthographic : bool
    ///     Whether rays are parallel.
    #[staticmethod]
    #[pyo3(signature = (azimuth=0.0, elevation=0.0, distance=None, *, fov=FOV, look_at=None, up=None,
        orthographic=false))]
    fn orbit(
        py: Python<'_>,
        azimuth: f64,
        elevation: f64,
        distance: Option<f64>,
        fov: f64,
        look_at: Option<[f64; 3]>,
        up: Option<&str>,
        orthographic: bool,
    ) -> PyResult<Self> {
        let orbit = Orbit {
            azimuth,
            elevation,
            distance,
            fov,
            look_at,
            up: values::up(py, up)?,
            orthographic,
        };
        let trial = Camera::orbit(azimuth, elevation, distance.unwrap_or(3.0), fov, SIZE.0, SIZE.1);
        trial.map_err(|error| errors::exception(py, &error))?;
        Ok(PyCamera {
            view: View::Orbit(orbit),
            name: format!("orbit {azimuth}, {elevation}"),
        })
    }

    /// A pinhole camera of a matrix.
    ///
    /// Parameters
    /// ----------
    /// matrix : array_like, [4, 4] or [3, 4]
    ///     Rotation and translation between the camera and the world, in units of the cloud. It takes columns
    ///     (x, y, z, 1); lengths stay as they are.
    /// fov : float, optional
    ///     Horizontal field of view in degrees; pixels are square and the principal point is the middle.
    /// intrinsics : array_like, [3, 3], or (fx, fy, cx, cy), optional
    ///     Focal lengths and principal point in pixels. The centre of the first pixel is (0.5, 0.5), as in COLMAP; add
    ///     0.5 to cx and cy where it is (0, 0), as in OpenCV.
    /// convention : {"opencv", "opengl"}
    ///     Axes of the camera: x right, y down, z forward (OpenCV, COLMAP), or x right, y up, z backward (OpenGL,
    ///     Blender, NeRF).
    /// kind : {"world_to_camera", "camera_to_world"}
    ///     What the matrix takes to what.
    /// size : (int, int), optional
    ///     Width and height that the intrinsics are for, and of the picture.
    /// near : float, optional
    ///     What is nearer is not drawn, in units of the cloud. By default 0.01 cube-frame units.
    #[staticmethod]
    #[pyo3(signature = (matrix, fov=None, intrinsics=None, *, convention="opencv", kind="world_to_camera", size=None,
        near=None))]
    fn from_matrix(
        matrix: &Bound<'_, PyAny>,
        fov: Option<f64>,
        intrinsics: Option<&Bound<'_, PyAny>>,
        convention: &str,
        kind: &str,
        size: Option<(u32, u32)>,
        near: Option<f64>,
    ) -> PyResult<Self> {
        let py = matrix.py();
        let lens = match (fov, intrinsics) {
            (Some(fov), None) => Lens::Fov(fov),
            (None, Some(intrinsics)) => Lens::Intrinsics(four(intrinsics)?),
            _ => return Err(errors::usage(py, "a camera takes either fov or intrinsics")),
        };
        let (rotation, translation) = pose(matrix, convention, kind)?;
        let view = Matrix {
            rotation,
            translation,
            lens,
            size,
            near,
        };
        let trial = view.camera(&Frame::default(), size.unwrap_or(SIZE));
        trial.map_err(|error| errors::exception(py, &error))?;
        Ok(PyCamera {
            view: View::Matrix(view),
            name: "matrix".into(),
        })
    }

    /// The cameras of a file: NeRF's transforms.json, COLMAP's images.txt beside its cameras.txt, Open3D's pinhole
    /// JSON, glTF or GLB.
    ///
    /// Parameters
    /// ----------
    /// path : path
    /// limits : Limits, optional
    ///
    /// Returns
    /// -------
    /// list of Camera
    ///     Their `name` is that of the picture. Files that state no size leave it to `render`.
    #[staticmethod]
    #[pyo3(signature = (path, *, limits=None))]
    fn load(py: Python<'_>, path: PathBuf, limits: Option<PyLimits>) -> PyResult<Vec<Self>> {
        let file = File::open(&path, &values::limits(limits)).map(Arc::new);
        let read = file.and_then(|file| {
            let names = |named: &[Named]| named.iter().map(|(name, _)| name.clone()).collect();
            let names: Vec<String> = file.with(&Frame::default(), SIZE, names)?;
            Ok((file, names))
        });
        let (file, names) = read.map_err(|error| errors::exception(py, &error))?;
        let camera = |(index, name)| PyCamera {
            view: View::File {
                file: file.clone(),
                index,
            },
            name,
        };
        Ok(names.into_iter().enumerate().map(camera).collect())
    }

    /// The name of the picture in the file that the camera is from.
    #[getter]
    fn name(&self) -> &str {
        &self.name
    }

    fn __repr__(&self) -> String {
        format!("<b2p.Camera: {}>", self.name)
    }
}

impl PyCamera {
    /// From the front, with the whole object in view.
    pub fn front() -> Self {
        let orbit = Orbit {
            azimuth: 0.0,
            elevation: 0.0,
            distance: None,
            fov: FOV,
            look_at: None,
            up: None,
            orthographic: false,
        };
        PyCamera {
            view: View::Orbit(orbit),
            name: "front".into(),
        }
    }

    /// The camera of the renderer. `size` is the one asked for; `up` the axis that points up by default.
    pub fn resolve(&self, frame: &Frame, extent: &Extent, up: Option<Up>, size: Option<(u32, u32)>) -> Result<Camera> {
        let usual = size.unwrap_or(SIZE);
        let camera = match &self.view {
            View::Orbit(orbit) => orbit.camera(frame, extent, up, usual)?,
            View::Matrix(view) => view.camera(frame, view.size.unwrap_or(usual))?,
            View::File { file, index } => {
                let camera = file.with(frame, usual, |named| named.get(*index).map(|(_, camera)| *camera))?;
                camera.ok_or_else(|| Error::Usage("the camera is not in its file".into()))?
            }
        };
        match size {
            Some((width, height)) if camera.size() != [width, height] => {
                let [own, rows] = camera.size();
                let what = format!("the camera takes pictures of {own}×{rows} pixels, not of {width}×{height}");
                Err(Error::Usage(what))
            }
            _ => Ok(camera),
        }
    }
}

impl Orbit {
    fn camera(&self, frame: &Frame, extent: &Extent, up: Option<Up>, (width, height): (u32, u32)) -> Result<Camera> {
        let target = self.target(frame, extent);
        let at = |radius: f64| {
            let camera = Camera::orbit_around(target, self.azimuth, self.elevation, radius, self.fov, width, height)?;
            let up = self.up.or(up);
            Ok::<_, Error>(up.map_or(camera, |up| camera.with_up(up, target)))
        };
        let projection = match self.orthographic {
            true => Projection::Orthographic,
            false => Projection::Pinhole,
        };
        let radius = match self.distance {
            Some(radius) => radius,
            None => at(3.0)?.radius_for(extent, target, projection),
        };
        let camera = at(radius)?;
        if !self.orthographic {
            return Ok(camera);
        }
        // Parallel rays see what is behind the camera's place no more than a pinhole does: it stands outside the cube.
        let mut far = at(radius.max(4.0))?;
        far.fx = camera.fx / radius;
        far.fy = far.fx;
        far.projection = projection;
        far.check()?;
        Ok(far)
    }

    /// The point that is looked at, in the cube frame.
    fn target(&self, frame: &Frame, extent: &Extent) -> [f64; 3] {
        let unit = frame.unit();
        let origin = frame.placement.origin;
        match (self.look_at, self.distance) {
            (Some(world), _) => std::array::from_fn(|axis| (world[axis] - origin[axis]) / unit - 1.0),
            (None, Some(_)) => [0.0; 3],
            (None, None) => extent.middle(),
        }
    }
}

impl Matrix {
    fn camera(&self, frame: &Frame, (width, height): (u32, u32)) -> Result<Camera> {
        let unit = frame.unit();
        let middle = frame.placement.origin.map(|low| low + unit);
        let row = |i: usize| {
            let turned: f64 = (0..3).map(|k| self.rotation[i][k] * middle[k]).sum();
            (turned + self.translation[i]) / unit
        };
        let translation = [row(0), row(1), row(2)];
        let focal = match self.lens {
            Lens::Fov(fov) if fov > 0.0 && fov < 180.0 => f64::from(width) / 2.0 / (fov.to_radians() / 2.0).tan(),
            Lens::Fov(fov) => {
                let what = format!("the field of view is {fov}°, it must lie between 0° and 180°");
                return Err(Error::Usage(what));
            }
            Lens::Intrinsics([fx, ..]) => fx,
        };
        let mut camera = Camera::new(self.rotation, translation, focal, width, height)?;
        if let Lens::Intrinsics([_, fy, cx, cy]) = self.lens {
            (camera.fy, camera.cx, camera.cy) = (fy, cx, cy);
        }
        if let Some(near) = self.near {
            camera.near = near / unit;
        }
        camera.check()?;
        Ok(camera)
    }
}

/// From a 4×4 or 3×4 matrix: rotation (rows) and translation from the world to axes x right, y down, z forward.
fn pose(matrix: &Bound<'_, PyAny>, convention: &str, kind: &str) -> PyResult<([[f64; 3]; 3], [f64; 3])> {
    let py = matrix.py();
    let array = as_array(matrix)?;
    if check("matrix", &array, &[Some(3), Some(4)]).is_err() {
        check("matrix", &array, &[Some(4), Some(4)])?;
    }
    let numbers: Vec<f64> = flat(&array)?;
    if let Some(last) = numbers
        .get(12..)
        .filter(|last| !last.is_empty() && *last != [0.0, 0.0, 0.0, 1.0])
    {
        return Err(errors::usage(
            py,
            format!("the last row of the matrix is {last:?}, expected [0, 0, 0, 1]"),
        ));
    }
    let mut rotation: [[f64; 3]; 3] = std::array::from_fn(|i| std::array::from_fn(|k| numbers[4 * i + k]));
    let mut translation: [f64; 3] = std::array::from_fn(|i| numbers[4 * i + 3]);
    match kind {
        "world_to_camera" => {}
        "camera_to_world" => {
            let turned: [[f64; 3]; 3] = std::array::from_fn(|i| std::array::from_fn(|k| rotation[k][i]));
            translation = turned.map(|row| -(0..3).map(|k| row[k] * translation[k]).sum::<f64>());
            rotation = turned;
        }
        other => {
            let what = format!("kind is {other:?}, expected \"world_to_camera\" or \"camera_to_world\"");
            return Err(errors::usage(py, what));
        }
    }
    match convention {
        "opencv" => {}
        "opengl" => {
            for i in [1, 2] {
                rotation[i] = rotation[i].map(|x| -x);
                translation[i] = -translation[i];
            }
        }
        other => {
            let what = format!("convention is {other:?}, expected \"opencv\" or \"opengl\"");
            return Err(errors::usage(py, what));
        }
    }
    Ok((rotation, translation))
}

/// fx, fy, cx, cy of a 3×3 matrix, or as they are.
fn four(intrinsics: &Bound<'_, PyAny>) -> PyResult<[f64; 4]> {
    let array = as_array(intrinsics)?;
    if check("intrinsics", &array, &[Some(4)]).is_ok() {
        let numbers: Vec<f64> = flat(&array)?;
        return Ok(std::array::from_fn(|i| numbers[i]));
    }
    check("intrinsics", &array, &[Some(3), Some(3)])?;
    match flat::<f64>(&array)?[..] {
        [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0] => Ok([fx, fy, cx, cy]),
        ref found => {
            let what = format!("the intrinsics are {found:?}, expected [fx, 0, cx, 0, fy, cy, 0, 0, 1]");
            Err(errors::usage(intrinsics.py(), what))
        }
    }
}
