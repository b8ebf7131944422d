//! How an object is posed, scaled and coloured for a sample.

use crate::error::Result;
use crate::random::Random;
use crate::sample::Grid;
use crate::surface::{Surface, Tint};
use crate::triplanar::Photograph;

use super::{Options, Photo};

/// What kind of object a file holds, told by its name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// `person_…`: what the codec is judged by.
    Person,
    /// `ds_…`, `tds_…`: a scan without colour, whose texture is an occlusion map.
    Statue,
    /// Anything else.
    Thing,
}

impl Kind {
    /// The kind that a name tells.
    pub fn of(name: &str) -> Self {
        if name.starts_with("person_") {
            Kind::Person
        } else if name.starts_with("ds_") || name.starts_with("tds_") {
            Kind::Statue
        } else {
            Kind::Thing
        }
    }

    /// How often an object comes up in a round through all.
    pub(super) fn weight(self) -> usize {
        if self == Kind::Person { 2 } else { 1 }
    }
}

/// One way to show an object.
#[derive(Debug, Clone)]
pub(super) struct Variant {
    rotation: glam::DQuat,
    bits: u8,
    fill: f64,
    /// Points drawn over the whole object.
    pub points: u64,
    /// Standard deviation of their places in voxels, per axis.
    pub noise: f64,
    photograph: bool,
    shaded: bool,
    tint: Option<Tint>,
}

/// The protocol's sampling: 15 million points over an object of 0.95 · 1024 voxels.
const PROTOCOL_POINTS: f64 = 15e6;
const PROTOCOL_FILL: f64 = 0.95;
const PROTOCOL_BITS: u8 = 10;
/// Parts the random numbers of noise from those of all else.
const NOISE: u64 = 0x006e_6f69_7365;

impl Variant {
    pub fn random(kind: Kind, options: &Options, photos: bool, random: &mut Random) -> Self {
        let small = random.chance(0.1);
        let bits = if small {
            options.crop.trailing_zeros() as u8
        } else {
            options.bits
        };
        let as_sampled = if kind == Kind::Person { 0.75 } else { 0.5 };
        let fill = if random.chance(as_sampled) {
            PROTOCOL_FILL
        } else {
            random.range(0.5, PROTOCOL_FILL)
        };
        // As dense in voxels as the protocol's own clouds.
        let side = fill / PROTOCOL_FILL * f64::from(1u32 << bits) / f64::from(1 << PROTOCOL_BITS);
        let dense = PROTOCOL_POINTS * side * side;
        // Random numbers of its own: a sample is the same but for the noise.
        let mut own = random.fork(NOISE);
        let (points, noise) = if own.chance(options.noisy) {
            (dense * own.log_range(0.06, 0.6), own.range(0.15, 0.8))
        } else {
            (dense, 0.0)
        };
        Variant {
            rotation: rotation(random),
            bits,
            fill,
            points: points as u64,
            noise,
            photograph: photos && (random.chance(0.35) || kind == Kind::Statue),
            shaded: kind == Kind::Statue,
            tint: random.chance(0.5).then(|| tint(random)),
        }
    }

    /// The object in voxel coordinates, and its grid.
    ///
    /// # Errors
    /// If the object has no extent.
    pub fn apply(&self, surface: &Surface, photos: &[Photo], random: &mut Random) -> Result<(Surface, Grid)> {
        let turn = |p: [f32; 3]| self.rotation * glam::Vec3::from(p).as_dvec3();
        let turned = surface.map(|p| turn(p).as_vec3().into());
        let fitted = Grid::fit(turned.bounds(), self.bits, self.fill)?;
        let mut placed = turned.map(|p| fitted.coordinate(p.map(f64::from)).map(|x| x as f32));
        if self.photograph {
            let (pyramid, aspect) = &photos[random.below(photos.len() as u64) as usize];
            let side = self.fill * f64::from(1u32 << self.bits);
            placed = placed.with_photograph(Photograph {
                pyramid: pyramid.clone(),
                period: (side / random.log_range(0.7, 4.0)) as f32,
                aspect: *aspect,
                offset: std::array::from_fn(|_| [random.unit() as f32, random.unit() as f32]),
                shaded: self.shaded,
            });
        }
        if let Some(tint) = self.tint {
            placed = placed.with_tint(tint);
        }
        Ok((placed, Grid::unit(self.bits)))
    }
}

/// Half as given, a quarter turned about the vertical, a quarter any way.
fn rotation(random: &mut Random) -> glam::DQuat {
    match random.below(4) {
        0 => {
            let q = std::array::from_fn(|_| random.normal());
            let q = glam::DQuat::from_array(q);
            if q.length_squared() > 1e-6 {
                q.normalize()
            } else {
                glam::DQuat::IDENTITY
            }
        }
        1 => glam::DQuat::from_rotation_y(random.range(0.0, std::f64::consts::TAU)),
        _ => glam::DQuat::IDENTITY,
    }
}

/// A slight change of colour.
fn tint(random: &mut Random) -> Tint {
    let gain = random.range(0.85, 1.1);
    Tint::new(
        (random.normal() * 0.12).clamp(-0.4, 0.4) as f32,
        random.range(0.85, 1.15) as f32,
        std::array::from_fn(|_| (gain * random.range(0.93, 1.07)) as f32),
    )
}
