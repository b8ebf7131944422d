//! The camera of a viewer: it turns around a point that it looks at.

use b2p::renderer::camera::{Camera, Extent, Projection};
use b2p::{Frame, Up};

use crate::args::Orbit;

/// The farthest from the horizon that the camera goes, in degrees.
const HIGHEST: f64 = 89.0;
/// How near and how far the camera may be, in units of the cube frame.
const NEAREST: f64 = 0.05;
const FARTHEST: f64 = 50.0;
/// How far from the middle of the cube the point that is looked at may be.
const REACH: f64 = 4.0;
/// Degrees that a drag over the height of the picture turns by.
const TURN: f64 = 180.0;

/// Where the camera starts.
#[derive(Debug, Clone, Copy)]
pub struct Start {
    pub orbit: Orbit,
    /// Horizontal field of view in degrees.
    pub fov: f64,
    /// The point that is looked at, in the units of the cloud.
    pub look_at: Option<[f64; 3]>,
}

/// A camera that turns around a point.
#[derive(Debug, Clone)]
pub struct OrbitCamera {
    start: Start,
    azimuth: f64,
    elevation: f64,
    distance: f64,
    target: [f64; 3],
    up: Option<Up>,
    /// What is to be kept in view until the user moves the camera.
    subject: Option<(Extent, Frame)>,
    moved: bool,
}

impl OrbitCamera {
    /// A camera that has nothing to look at yet.
    pub fn new(start: Start) -> Self {
        OrbitCamera {
            start,
            azimuth: start.orbit.azimuth,
            elevation: start.orbit.elevation,
            distance: start.orbit.distance.unwrap_or(3.0),
            target: [0.0; 3],
            up: None,
            subject: None,
            moved: false,
        }
    }

    /// Looks at an object that takes `extent` of the cube `frame`. If there is one already, the camera stays.
    pub fn look_at(&mut self, extent: Extent, frame: Frame, up: Option<Up>, size: [u32; 2]) {
        if self.subject.is_none() {
            self.up = up;
            self.subject = Some((extent, frame));
            self.reset(size);
        }
    }

    /// Forgets the object: the next one is looked at from the start.
    pub fn forget(&mut self) {
        *self = OrbitCamera::new(self.start);
    }

    /// As at the start: the whole object in view, unless a distance was given.
    pub fn reset(&mut self, size: [u32; 2]) {
        let Some((extent, frame)) = &self.subject else { return };
        let Start { orbit, look_at, .. } = self.start;
        (self.azimuth, self.elevation, self.moved) = (orbit.azimuth, orbit.elevation, false);
        self.target = crate::views::target(look_at, orbit.distance, frame, extent);
        self.distance = match orbit.distance {
            Some(distance) => distance,
            None => {
                self.distance = 3.0;
                let camera = self.camera(size);
                let fitting = camera.map(|camera| camera.radius_for(extent, self.target, Projection::Pinhole));
                fitting.unwrap_or(self.distance)
            }
        };
    }

    /// The window has another size: a camera that was not moved keeps the whole object in view.
    pub fn resize(&mut self, size: [u32; 2]) {
        if !self.moved {
            self.reset(size);
        }
    }

    /// Turns by a drag of so many pixels.
    pub fn drag(&mut self, [dx, dy]: [f64; 2], [_, height]: [u32; 2]) {
        let degrees = TURN / f64::from(height.max(1));
        self.turn(-dx * degrees, dy * degrees);
    }

    /// Turns by degrees.
    pub fn turn(&mut self, azimuth: f64, elevation: f64) {
        self.moved = true;
        self.azimuth = (self.azimuth + azimuth).rem_euclid(360.0);
        self.elevation = (self.elevation + elevation).clamp(-HIGHEST, HIGHEST);
    }

    /// Comes nearer, or goes away: the distance is multiplied.
    pub fn zoom(&mut self, factor: f64) {
        self.moved = true;
        self.distance = (self.distance * factor).clamp(NEAREST, FARTHEST);
    }

    /// Moves the point that is looked at, so that what is at its distance follows a drag of so many pixels.
    pub fn pan(&mut self, [dx, dy]: [f64; 2], size: [u32; 2]) {
        let Ok(camera) = self.camera(size) else { return };
        self.moved = true;
        let units = self.distance / camera.fx;
        let [right, down] = [camera.pose.matrix3.row(0), camera.pose.matrix3.row(1)];
        let shift = (right * dx + down * dy) * units;
        for (at, by) in self.target.iter_mut().zip(shift.to_array()) {
            *at = (*at - by).clamp(-REACH, REACH);
        }
    }

    /// The camera of a picture of this size.
    ///
    /// # Errors
    /// [`b2p::Error::Usage`] if that is none, such as for an empty picture.
    pub fn camera(&self, [width, height]: [u32; 2]) -> b2p::Result<Camera> {
        let (target, fov) = (self.target, self.start.fov);
        let camera = Camera::orbit_around(target, self.azimuth, self.elevation, self.distance, fov, width, height)?;
        Ok(self.up.map_or(camera, |up| camera.with_up(up, target)))
    }

    /// The options of `b2p render` for the same picture.
    pub fn options(&self, [width, height]: [u32; 2]) -> String {
        let frame = self.subject.as_ref().map_or(Frame::default(), |(_, frame)| *frame);
        let world = |axis: usize| frame.placement.origin[axis] + (self.target[axis] + 1.0) * frame.unit();
        let [x, y, z] = [0, 1, 2].map(world);
        let (azimuth, elevation, distance) = (self.azimuth, self.elevation, self.distance);
        let mut options =
            format!("--size {width}x{height} --orbit {azimuth},{elevation},{distance} --look-at {x},{y},{z}");
        if self.start.fov != 45.0 {
            options += &format!(" --fov {}", self.start.fov);
        }
        options
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [u32; 2] = [640, 480];

    fn looking(distance: Option<f64>) -> OrbitCamera {
        let orbit = Orbit {
            azimuth: 20.0,
            elevation: 10.0,
            distance,
        };
        let mut camera = OrbitCamera::new(Start {
            orbit,
            fov: 45.0,
            look_at: None,
        });
        camera.look_at(ball([0.1, 0.2, -0.3]), Frame::default(), None, SIZE);
        camera
    }

    fn ball(centre: [f64; 3]) -> Extent {
        Extent::of([(centre, 0.25)].into_iter())
    }

    fn pixel(camera: &OrbitCamera, point: [f64; 3]) -> [f64; 2] {
        let camera = camera.camera(SIZE).unwrap();
        let at = camera.pose.transform_point3(point.into());
        [camera.fx * at.x / at.z + camera.cx, camera.fy * at.y / at.z + camera.cy]
    }

    #[test]
    fn a_camera_starts_where_that_of_render_stands() {
        let extent = ball([0.1, 0.2, -0.3]);
        let at = |radius| Camera::orbit_around(extent.middle(), 20.0, 10.0, radius, 45.0, 640, 480).unwrap();
        let radius = at(3.0).radius_for(&extent, extent.middle(), Projection::Pinhole);
        assert_eq!(looking(None).camera(SIZE).unwrap(), at(radius));
        let far = Camera::orbit(20.0, 10.0, 2.6, 45.0, 640, 480).unwrap();
        assert_eq!(looking(Some(2.6)).camera(SIZE).unwrap(), far);
    }

    #[test]
    fn finer_levels_leave_the_camera_where_it_is() {
        let mut camera = looking(None);
        let before = camera.camera(SIZE).unwrap();
        camera.look_at(ball([-0.5; 3]), Frame::default(), Some(Up::Z), SIZE);
        assert_eq!(camera.camera(SIZE).unwrap(), before);
    }

    #[test]
    fn what_is_panned_follows_the_mouse() {
        for up in [None, Some(Up::Z), Some(Up::MinusX)] {
            let mut camera = looking(None);
            camera.up = up;
            let middle = camera.target;
            camera.pan([30.0, -20.0], SIZE);
            let [x, y] = pixel(&camera, middle);
            assert!((x - 350.0).abs() < 1e-6 && (y - 220.0).abs() < 1e-6, "{up:?}: {x}, {y}");
        }
    }

    #[test]
    fn a_drag_turns_what_is_in_front_towards_where_the_mouse_goes() {
        let mut camera = looking(None);
        let middle = camera.target;
        let eye = camera.camera(SIZE).unwrap().pose.inverse().translation;
        let front: [f64; 3] = [0, 1, 2].map(|k| middle[k] + 0.2 * (eye[k] - middle[k]));
        camera.drag([40.0, 30.0], SIZE);
        let [x, y] = pixel(&camera, front);
        assert!(x > 320.0 && y > 240.0, "{x}, {y}");
        camera.drag([0.0, 1e6], SIZE);
        assert_eq!(camera.elevation, HIGHEST);
    }

    #[test]
    fn a_reset_undoes_all_moves_and_a_resize_only_fits_what_was_not_moved() {
        let mut camera = looking(None);
        let before = camera.camera(SIZE).unwrap();
        camera.zoom(0.5);
        camera.turn(10.0, 5.0);
        camera.pan([10.0, 10.0], SIZE);
        let moved = camera.distance;
        camera.resize([100, 400]);
        assert_eq!(camera.distance, moved);
        camera.reset(SIZE);
        assert_eq!(camera.camera(SIZE).unwrap(), before);
        camera.resize([100, 400]);
        assert!(camera.distance > moved);
    }

    #[test]
    fn a_camera_stays_within_bounds_and_refuses_pictures_of_no_pixels() {
        let mut camera = looking(None);
        for _ in 0..100 {
            camera.zoom(0.5);
            camera.pan([1e9, 1e9], SIZE);
        }
        assert_eq!(camera.distance, NEAREST);
        assert!(camera.target.iter().all(|x| x.abs() <= REACH));
        camera.zoom(1e9);
        assert_eq!(camera.distance, FARTHEST);
        assert!(camera.camera([0, 10]).is_err());
    }
}
