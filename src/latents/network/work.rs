//! How much there is to compute: for benchmarks, and for estimates of time.

use super::shape::Shape;
use crate::gaussians::Heads;
use crate::geometry::KernelMap;
use crate::layers::Spec;

/// A part of the network that a decoder runs on a level, and the level's role.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Module {
    /// The context from the level above: [`super::Model::upsample`].
    Context(usize),
    /// [`super::Model::entropy_parameters`].
    Probabilities(usize),
    /// [`super::Model::reconstruct`].
    Features(usize),
    /// [`super::Model::generate_with`].
    Gaussians(usize, Heads),
}

impl Module {
    /// What a decoder calls this step on level `level` in its log.
    pub fn at(self, level: u8) -> String {
        match self {
            Module::Context(_) => format!("context of level {level}"),
            Module::Probabilities(_) => format!("probabilities of level {level}"),
            Module::Features(_) => format!("features of level {level}"),
            Module::Gaussians(..) => format!("generate Gaussians of level {level}"),
        }
    }
}

/// What a module takes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Work {
    /// Multiply–accumulates, those with absent neighbours not counted.
    pub macs: u64,
    /// Bytes that its layers must read and write at least once: activations and weights of 16 bits, kernel maps.
    pub bytes: u64,
}

impl Shape {
    /// The work of a module on the level with this 3³ kernel map.
    ///
    /// # Panics
    /// If `map` is not a 3³ map.
    pub fn work(&self, module: Module, map: &KernelMap) -> Work {
        let head = match module {
            Module::Gaussians(role, heads) => self.head(role, heads),
            _ => None,
        };
        let eight = head.is_some_and(|head| head.children == 8);
        let same = Support::of(map);
        let children = eight.then(|| Support::of_children(map));
        let mut work = Work::default();
        let mut after = false;
        for spec in self.layers(module) {
            // In a generator, layer 4 is where the children come in.
            let fourth = matches!(module, Module::Gaussians(..)) && spec.volume == 8;
            let support = match &children {
                Some(children) if after || fourth => children,
                _ => &same,
            };
            let pairs = match spec.volume {
                27 => support.pairs,
                8 if fourth && children.is_none() => forward(map),
                _ => support.rows,
            };
            after |= fourth;
            work.macs += pairs * (spec.cin * spec.cout) as u64;
            let weights = spec.volume * spec.cin * spec.cout;
            work.bytes += 2 * (support.rows * (spec.cin + spec.cout) as u64 + weights as u64);
            if spec.volume == 27 {
                work.bytes += 27 * 4 * support.rows;
            }
        }
        work
    }

    /// The layers of a module, in the order in which they run.
    fn layers(&self, module: Module) -> Vec<Spec> {
        let prefix = match module {
            Module::Context(role) => format!("up.{role}"),
            Module::Probabilities(role) => format!("pem.{role}."),
            Module::Features(role) => format!("fr.{role}."),
            Module::Gaussians(role, heads) => match self.head(role, heads) {
                Some(head) => format!("{}.", head.module()),
                None => return Vec::new(),
            },
        };
        let mut layers = Vec::new();
        let mut note = |spec: Spec| {
            if spec.name.starts_with(&prefix) {
                layers.push(spec);
            }
            Ok(())
        };
        // Taking notes cannot fail.
        let _ = self.exact(&mut note);
        let _ = self.generators(&mut note);
        layers
    }
}

/// What there is of a level.
struct Support {
    rows: u64,
    /// Pairs of a voxel and an occupied neighbour, itself among them.
    pairs: u64,
}

/// Pairs of a voxel and an occupied neighbour at offsets 0 and 1.
fn forward(map: &KernelMap) -> u64 {
    let forward = map.forward();
    let occupied = forward.rows().iter().filter(|&&q| q != KernelMap::ABSENT);
    occupied.count() as u64
}

impl Support {
    fn of(map: &KernelMap) -> Support {
        assert_eq!(map.volume(), 27, "work is counted on a 3³ map");
        let occupied = |&&index: &&u32| index != KernelMap::ABSENT;
        Support {
            rows: map.len() as u64,
            pairs: map.rows().iter().filter(occupied).count() as u64,
        }
    }

    /// Of all eight children of every voxel.
    fn of_children(map: &KernelMap) -> Support {
        // Along an axis, of a voxel's two children each reads itself and the other, and one of them one of the
        // neighbour's.
        let along = |step: usize| if step % 3 == 1 { 4 } else { 1 };
        let mut pairs = 0;
        for row in map.rows().chunks_exact(27) {
            let occupied = row.iter().enumerate().filter(|(_, q)| **q != KernelMap::ABSENT);
            pairs += occupied
                .map(|(k, _)| along(k) * along(k / 3) * along(k / 9))
                .sum::<u64>();
        }
        Support {
            rows: 8 * map.len() as u64,
            pairs,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Octree, Voxels};
    use crate::latents::network::RAW;

    #[test]
    fn a_lone_voxel_takes_one_tap_of_every_layer() {
        let octree = Octree::new(Voxels::new(2, vec![9])).unwrap();
        let map = octree.kernel_map(2);
        let shape = Shape::tiny();
        let (c, k) = (shape.channels as u64, shape.latents as u64);
        let inception = c * c / 4 + c / 4 * (c / 2) + c * c / 4 + c / 4 * (c / 4) + c / 4 * (c / 2);
        let macs = |module| shape.work(module, &map).macs;
        assert_eq!(macs(Module::Context(1)), c * c);
        assert_eq!(macs(Module::Probabilities(1)), c * c + inception + 2 * c * k);
        assert_eq!(macs(Module::Features(2)), (k + c) * c + inception + c * c);
        let raw = RAW as u64;
        assert_eq!(
            macs(Module::Gaussians(2, Heads::Best)),
            c * c * (1 + 2 + 1 + 2) + c * raw
        );
        // Eight children, all neighbours of each other.
        assert_eq!(
            macs(Module::Gaussians(1, Heads::Best)),
            c * c * (1 + 2 + 8 + 64 * 2) + 64 * c * raw
        );
    }
}
