//! The clouds to train on.

use b2p::geometry::{Voxels, morton};
use glam::{DQuat, DVec3, Vec3};

use crate::error::Result;
use crate::random::Random;
use crate::sample::{Grid, Sampler};
use crate::surface::Surface;

/// The deepest level of every cloud: the finest that a stream of a 10-bit cloud codes.
const BITS: u8 = 9;
const SIDE: f64 = (1 << BITS) as f64;

/// As dense as 15 million points in a cloud of 10 bits.
const POINTS: f64 = 15e6 / 4.0;
const FILL: f64 = 0.95;

/// An object, as clouds: as it stands, turned about the vertical, turned any way and smaller, and either rough or one
/// side alone.
///
/// # Errors
/// If the object has no area.
pub fn views(object: &Surface, random: &mut Random) -> Result<Vec<Voxels>> {
    let as_it_stands = cloud(object, DQuat::IDENTITY, FILL, random)?;
    let about = DQuat::from_rotation_y(random.range(0.0, std::f64::consts::TAU));
    let about = cloud(object, about, FILL, random)?;
    let fill = random.range(0.4, FILL);
    let smaller = cloud(object, turn(random), fill, random)?;
    let other = cloud(object, turn(random), FILL, random)?;
    let other = if random.chance(0.5) {
        let deviation = random.log_range(0.15, 1.5);
        let kept = random.log_range(0.1, 1.0);
        rough(&other, deviation, kept, random)
    } else {
        one_side(&other, random.below(6))
    };
    Ok(vec![as_it_stands, about, smaller, other])
}

fn turn(random: &mut Random) -> DQuat {
    let q: [f64; 4] = std::array::from_fn(|_| random.normal());
    DQuat::from_array(q).normalize()
}

fn cloud(object: &Surface, turn: DQuat, fill: f64, random: &mut Random) -> Result<Voxels> {
    let turned = object.map(|p| (turn * Vec3::from(p).as_dvec3()).as_vec3().into());
    let grid = Grid::fit(turned.bounds(), BITS, fill)?;
    let points = POINTS * (fill / FILL) * (fill / FILL);
    let sampled = Sampler::new(&turned, grid, points as u64, random.bits())?.cloud(None);
    Ok(Voxels::from_sorted(BITS, sampled.keys))
}

/// Some of the voxels, each moved by a normal vector.
fn rough(voxels: &Voxels, deviation: f64, kept: f64, random: &mut Random) -> Voxels {
    let mut keys = Vec::new();
    for i in 0..voxels.len() {
        if random.chance(kept) {
            let at = voxels
                .coordinate(i)
                .map(|x| f64::from(x) + 0.5 + deviation * random.normal());
            keys.extend(key(at.into()));
        }
    }
    Voxels::new(BITS, keys)
}

/// What a depth camera would see: of every line along an axis, the first voxel from one end.
fn one_side(voxels: &Voxels, direction: u64) -> Voxels {
    let (axis, far_first) = ((direction / 2) as usize, direction % 2 == 1);
    let mut seen: Vec<([u32; 3], u64)> = voxels
        .keys()
        .iter()
        .map(|&key| {
            let mut at = morton::decode(key);
            at.swap(axis, 2);
            if far_first {
                at[2] = !at[2];
            }
            (at, key)
        })
        .collect();
    seen.sort_unstable();
    seen.dedup_by_key(|(at, _)| [at[0], at[1]]);
    Voxels::new(BITS, seen.into_iter().map(|(_, key)| key).collect())
}

/// Points, curves, solids, thick and thin shells, boxes: `rounds` of each.
pub fn shapes(rounds: usize, random: &mut Random) -> Vec<Voxels> {
    let makers = [points, curve, ball, shell, graph, boxes];
    let mut shapes = Vec::new();
    for _ in 0..rounds {
        shapes.extend(makers.map(|make| Voxels::new(BITS, make(random))));
    }
    shapes
}

/// The key of the voxel at a point, if it lies inside.
fn key(at: DVec3) -> Option<u64> {
    let inside = at.min_element() >= 0.0 && at.max_element() < SIDE;
    inside.then(|| morton::encode(at.to_array().map(|x| x as u32)))
}

fn anywhere(random: &mut Random) -> DVec3 {
    SIDE * DVec3::from_array(std::array::from_fn(|_| random.unit()))
}

fn points(random: &mut Random) -> Vec<u64> {
    let count = random.log_range(100.0, 1e5) as usize;
    (0..count).filter_map(|_| key(anywhere(random))).collect()
}

fn curve(random: &mut Random) -> Vec<u64> {
    let (frequency, phase): ([f64; 3], [f64; 3]) = (
        std::array::from_fn(|_| random.range(1.0, 20.0)),
        std::array::from_fn(|_| random.range(0.0, 6.3)),
    );
    let at = |t: f64| DVec3::from_array(std::array::from_fn(|i| 0.5 + 0.4 * (frequency[i] * t + phase[i]).sin()));
    (0..100_000)
        .filter_map(|i| key(SIDE * at(f64::from(i) * 1e-5)))
        .collect()
}

fn ball(random: &mut Random) -> Vec<u64> {
    let (centre, radius) = (anywhere(random), random.range(10.0, 50.0));
    let mut keys = Vec::new();
    let reach = radius as i32 + 1;
    for z in -reach..=reach {
        for y in -reach..=reach {
            for x in -reach..=reach {
                let step = DVec3::new(x.into(), y.into(), z.into());
                if step.length() < radius {
                    keys.extend(key(centre + step));
                }
            }
        }
    }
    keys
}

fn shell(random: &mut Random) -> Vec<u64> {
    let (radius, thickness) = (random.range(30.0, 150.0), random.log_range(0.2, 3.0));
    let count = (radius * radius * random.log_range(1.0, 30.0)) as usize;
    (0..count)
        .filter_map(|_| {
            let direction = turn(random) * DVec3::X;
            key(SIDE / 2.0 + direction * (radius + thickness * random.normal()))
        })
        .collect()
}

/// The graph of a smooth function: one voxel per column.
fn graph(random: &mut Random) -> Vec<u64> {
    let waves: [(f64, f64, f64, f64); 4] = std::array::from_fn(|_| {
        let length = random.log_range(40.0, 1000.0);
        let angle = random.range(0.0, 6.3);
        let slope = random.range(0.0, 0.6);
        (
            angle.cos() / length,
            angle.sin() / length,
            random.range(0.0, 6.3),
            slope * length,
        )
    });
    let axis = random.below(3) as usize;
    let mut keys = Vec::new();
    for y in 0..1 << (BITS - 1) {
        for x in 0..1 << (BITS - 1) {
            let [x, y] = [f64::from(x), f64::from(y)];
            let height = waves
                .iter()
                .map(|(kx, ky, phase, size)| size * (kx * x + ky * y + phase).sin());
            let mut at = [x, y, SIDE / 2.0 + height.sum::<f64>()];
            at.swap(axis, 2);
            keys.extend(key(at.into()));
        }
    }
    keys
}

fn boxes(random: &mut Random) -> Vec<u64> {
    let mut keys = Vec::new();
    for _ in 0..6 {
        let low = (0.7 * anywhere(random)).floor();
        let size = (0.25 * anywhere(random)).ceil();
        for axis in 0..3 {
            let [u, v] = [(axis + 1) % 3, (axis + 2) % 3];
            for face in [0.0, size[axis]] {
                for i in 0..=size[u] as u32 {
                    for j in 0..=size[v] as u32 {
                        let mut at = low;
                        at[axis] += face;
                        at[u] += f64::from(i);
                        at[v] += f64::from(j);
                        keys.extend(key(at));
                    }
                }
            }
        }
    }
    keys
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_side_has_one_voxel_per_column() {
        let solid = Voxels::new(BITS, ball(&mut Random::new(1)));
        for direction in 0..6 {
            let side = one_side(&solid, direction);
            let axis = direction as usize / 2;
            let mut columns: Vec<_> = (0..side.len()).map(|i| side.coordinate(i)).collect();
            columns.iter_mut().for_each(|at| at[axis] = 0);
            columns.sort_unstable();
            columns.dedup();
            assert_eq!(columns.len(), side.len());
        }
    }

    #[test]
    fn every_shape_has_voxels() {
        assert!(shapes(3, &mut Random::new(2)).iter().all(|shape| shape.len() > 50));
    }
}
