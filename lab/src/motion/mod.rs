//! Surfaces that move, and sequences of clouds sampled from them.
//!
//! A [`Motion`] is a surface at any time; a [`Sequence`] says which frames of it are sampled, how, and on which grid.
//! It is written beside its clouds as [`RECIPE`], from which the truth of every frame can be made again.

mod procedural;
mod sequence;

pub use procedural::Procedural;
pub use sequence::{FrameInfo, GridRecipe, RECIPE, Sequence, Source};

use crate::mesh::animated::Animated;
use crate::surface::Surface;

/// A surface that moves.
#[derive(Debug)]
pub enum Motion {
    /// An animated file, and its surface in any pose.
    File(Box<Animated>, Surface),
    /// A motion made by code, and what it moves.
    Procedural(Procedural, Surface),
}

impl Motion {
    /// The motion of an animated file.
    pub fn of_file(animated: Animated) -> Self {
        let surface = Surface::new(&animated.mesh());
        Motion::File(Box::new(animated), surface)
    }

    /// A motion made by code.
    pub fn of_code(motion: Procedural) -> Self {
        Motion::Procedural(motion, Surface::new(&motion.mesh()))
    }

    /// How long it lasts in seconds; None if it has no end.
    pub fn duration(&self) -> Option<f64> {
        match self {
            Motion::File(animated, _) => Some(animated.span()[1] - animated.span()[0]),
            Motion::Procedural(..) => None,
        }
    }

    /// The surface `time` seconds after the motion begins. After its end it stays as it is.
    pub fn at(&self, time: f64) -> Surface {
        match self {
            Motion::File(animated, surface) => surface.with_positions(animated.pose(animated.span()[0] + time)),
            Motion::Procedural(motion, surface) => surface.map(|p| motion.moved(p, time)),
        }
    }
}
