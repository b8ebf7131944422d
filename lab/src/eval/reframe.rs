//! Gaussians into the cube that the truth is in.

use b2p::gaussians::{Frame, Gaussians};
use b2p::placement::Placement;

/// The same Gaussians with coordinates in the cube of `frame`.
///
/// They stay where they are in the world. Gaussians whose world is a bare voxel grid have no other place: their grid is
/// taken to be `frame`'s, of whatever depth.
pub fn into_frame(mut gaussians: Gaussians, frame: Frame) -> Gaussians {
    let from = gaussians.frame;
    gaussians.frame = frame;
    if from.placement == Placement::VOXEL_GRID || from == frame {
        return gaussians;
    }
    for position in &mut gaussians.position {
        let world = from.placement.from_cube(from.bits, *position);
        *position = frame.placement.to_cube(frame.bits, world);
    }
    let unit = |f: Frame| f64::from(1u32 << f.bits) * f.placement.voxel_size;
    let ratio = (unit(from) / unit(frame)) as f32;
    gaussians.blur *= ratio * ratio;
    for scale in &mut gaussians.scale {
        *scale = scale.map(|s| s * ratio);
    }
    gaussians
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one(frame: Frame) -> Gaussians {
        Gaussians {
            position: vec![[0.5, 0.0, -1.0]],
            scale: vec![[0.1, 0.2, 0.3]],
            rotation: vec![[1.0, 0.0, 0.0, 0.0]],
            opacity: vec![1.0],
            colour: vec![[0.0; 3]],
            frame,
            ..Gaussians::default()
        }
    }

    fn metres(bits: u8, origin: f64, voxel_size: f64) -> Frame {
        let origin = [origin; 3];
        let placement = Placement { origin, voxel_size };
        Frame { bits, placement }
    }

    #[test]
    fn a_cube_twice_as_large_halves_coordinates_and_deviations() {
        let (small, large) = (metres(4, -8.0, 1.0), metres(5, -16.0, 1.0));
        let moved = into_frame(one(small), large);
        assert_eq!(moved.position, [[0.25, 0.0, -0.5]]);
        assert_eq!(moved.scale, [[0.05, 0.1, 0.15]]);
        assert_eq!(moved.frame, large);
    }

    #[test]
    fn a_bare_grid_is_the_cube_itself() {
        let grid = Frame::default();
        let here = metres(10, 3.0, 0.01);
        let moved = into_frame(one(grid), here);
        assert_eq!(moved.position, one(grid).position);
        assert_eq!(moved.frame, here);
    }
}
