//! The clipping box: what is outside of it is not drawn.

use b2p::{Extent, Gaussians, Harmonics};

use super::state::Effect;

/// A box in the cube frame, one axis of which keys move.
#[derive(Debug, Clone, PartialEq)]
pub struct Clip {
    on: bool,
    axis: usize,
    corners: [[f32; 3]; 2],
}

impl Default for Clip {
    /// Off, around the cube.
    fn default() -> Self {
        Clip {
            on: false,
            axis: 0,
            corners: CUBE,
        }
    }
}

const CUBE: [[f32; 3]; 2] = [[-1.0; 3], [1.0; 3]];

impl Clip {
    /// The lowest and the highest corner, if the box is on.
    pub fn corners(&self) -> Option<[[f32; 3]; 2]> {
        self.on.then_some(self.corners)
    }

    /// On or off. A box that was not moved yet is put around the object.
    pub fn toggle(&mut self, extent: Option<&Extent>) {
        self.on = !self.on;
        if let (true, CUBE, Some(extent)) = (self.on, self.corners, extent) {
            self.corners = extent.corners().map(|corner| corner.map(|x| x as f32));
        }
    }

    /// Moves faces of this axis from now on.
    pub fn choose(&mut self, axis: usize) -> Effect {
        self.axis = axis;
        match self.on {
            true => Effect::Overlay,
            false => Effect::Nothing,
        }
    }

    /// Moves a face along the axis, no further than to the cube and to the other face.
    pub fn shift(&mut self, high: bool, by: f32) -> Effect {
        if !self.on {
            return Effect::Nothing;
        }
        let [low_corner, high_corner] = &mut self.corners;
        let (low, top) = (&mut low_corner[self.axis], &mut high_corner[self.axis]);
        match high {
            true => *top = (*top + by).clamp(*low, 1.0),
            false => *low = (*low + by).clamp(-1.0, *top),
        }
        Effect::Draw
    }

    /// The box and its axis in words, if it is on.
    pub fn describe(&self) -> Option<String> {
        let [low, high] = self.corners()?;
        let sides = ["x", "y", "z"].into_iter().enumerate().map(|(axis, name)| {
            let mark = if axis == self.axis { "*" } else { "" };
            format!("{name}{mark} {:.2} to {:.2}", low[axis], high[axis])
        });
        Some(format!("box {}", sides.collect::<Vec<_>>().join(", ")))
    }
}

/// The Gaussians whose centres are in a box, faces included.
pub fn inside(all: &Gaussians, [low, high]: [[f32; 3]; 2]) -> Gaussians {
    let is_in = |at: &[f32; 3]| (0..3).all(|axis| (low[axis]..=high[axis]).contains(&at[axis]));
    let kept: Vec<bool> = all.position.iter().map(is_in).collect();
    let each = all.harmonics.count;
    let coefficients = all.harmonics.coefficients.chunks_exact(each.max(1)).zip(&kept);
    let coefficients = coefficients.filter(|(_, kept)| **kept).flat_map(|(own, _)| own);
    Gaussians {
        position: some(&all.position, &kept),
        scale: some(&all.scale, &kept),
        rotation: some(&all.rotation, &kept),
        opacity: some(&all.opacity, &kept),
        colour: some(&all.colour, &kept),
        harmonics: Harmonics {
            count: each,
            coefficients: coefficients.copied().collect(),
        },
        ..*all
    }
}

fn some<T: Copy>(all: &[T], kept: &[bool]) -> Vec<T> {
    let pairs = all.iter().zip(kept).filter(|(_, kept)| **kept);
    pairs.map(|(value, _)| *value).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn extent() -> Extent {
        Extent::of([([0.0; 3], 0.5)].into_iter())
    }

    fn line_of_gaussians() -> Gaussians {
        let mut all = Gaussians::default();
        for i in 0..5 {
            all.position.push([i as f32 * 0.25 - 0.5, 0.0, 0.0]);
            all.scale.push([0.01; 3]);
            all.rotation.push([1.0, 0.0, 0.0, 0.0]);
            all.opacity.push(i as f32 / 5.0);
            all.colour.push([0.2; 3]);
        }
        all
    }

    #[test]
    fn a_box_begins_around_the_object_and_keeps_its_place_when_it_is_off() {
        let mut clip = Clip::default();
        assert_eq!(clip.corners(), None);
        clip.toggle(Some(&extent()));
        assert_eq!(clip.corners(), Some([[-0.5; 3], [0.5; 3]]));
        assert_eq!(clip.shift(true, -0.25), Effect::Draw);
        clip.toggle(None);
        assert_eq!(clip.corners(), None);
        assert_eq!(clip.shift(true, -0.25), Effect::Nothing);
        clip.toggle(Some(&extent()));
        assert_eq!(clip.corners(), Some([[-0.5; 3], [0.25, 0.5, 0.5]]));
    }

    #[test]
    fn faces_do_not_pass_each_other_nor_the_cube() {
        let mut clip = Clip::default();
        clip.toggle(Some(&extent()));
        clip.choose(2);
        clip.shift(false, 9.0);
        assert_eq!(clip.corners().unwrap()[0], [-0.5, -0.5, 0.5]);
        clip.shift(true, 9.0);
        clip.shift(false, -9.0);
        assert_eq!(clip.corners().unwrap(), [[-0.5, -0.5, -1.0], [0.5, 0.5, 1.0]]);
        assert!(clip.describe().unwrap().contains("z* -1.00 to 1.00"));
    }

    #[test]
    fn what_is_in_the_box_stays_as_it_is() {
        let all = line_of_gaussians();
        let some = inside(&all, [[-0.25, -1.0, -1.0], [0.25, 1.0, 1.0]]);
        assert_eq!(some.position, all.position[1..4]);
        assert_eq!(some.opacity, all.opacity[1..4]);
        some.check_lengths().unwrap();
        assert_eq!(inside(&all, CUBE), all);
        assert!(inside(&all, [[0.9; 3], [0.9; 3]]).is_empty());
        let mut dependent = all.clone();
        dependent.harmonics.count = 3;
        dependent.harmonics.coefficients = (0..15).map(|i| [i as f32; 3]).collect();
        let last = inside(&dependent, [[0.4, -1.0, -1.0], [1.0; 3]]);
        last.check_lengths().unwrap();
        assert_eq!(last.harmonics.coefficients, dependent.harmonics.coefficients[12..]);
    }
}
