//! The levels of a stream: what all streams of a cloud have in common, what its latents say, and both put together.

use super::corrections::{Corrections, Left, Level};
use crate::container::{Header, Writer};
use crate::error::Result;
use crate::gaussians::Heads;
use crate::geometry::{KernelMap, Octree, codec};
use crate::latents::ColourFilter;
use crate::latents::entropy::{Coding, Condition, latent_hash};
use crate::latents::network::Model;
use crate::log::Log;

/// A role's latents, K per voxel of its level, given what they are coded under and its context.
pub(crate) type Latents<'a> = dyn FnMut(usize, Coding<'_>, Option<&[i16]>) -> Result<Vec<i16>> + 'a;

/// What to say of a level's colours.
pub(crate) type Correct<'a> = dyn FnMut(Level<'_>) -> Result<Corrections> + 'a;

/// The code of an octree level's geometry: the children of each slice, and its bytes.
type Geometry = Vec<(u32, Vec<u8>)>;

/// What all streams of a cloud's levels have in common: everything but features and corrections of colours.
pub(crate) struct Skeleton<'m> {
    model: &'m Model,
    pub(super) header: Header,
    pub octree: Octree,
    /// The levels' 3³ kernel maps.
    maps: Vec<KernelMap>,
    /// For each role, its level's, after those of levels that are not coded.
    geometry: Vec<Vec<(u8, Geometry)>>,
}

/// What latents and corrections say along a [`Skeleton`], but for the residual, which may be any.
pub(crate) struct Coded {
    levels: Vec<CodedLevel>,
    /// The features of the last level.
    pub features: Vec<i16>,
    /// What residuals would be of, level by level.
    pub left: Vec<Left>,
}

#[derive(Default)]
struct CodedLevel {
    /// The hash of its latents, and their slices, if it has any.
    features: Option<(u64, Vec<Vec<u8>>)>,
    filters: Vec<(Heads, ColourFilter)>,
}

impl<'m> Skeleton<'m> {
    /// Codes the geometry of the `header`'s levels of an octree; voxels and sections are filled in. `maps` are the
    /// levels' 3³ kernel maps.
    ///
    /// # Errors
    /// Those of [`Writer::new`].
    pub fn new(header: Header, octree: Octree, maps: Vec<KernelMap>, model: &'m Model, log: &Log) -> Result<Self> {
        let levels = header.base..=header.top;
        let voxels = levels.clone().map(|level| octree.level(level).len() as u32);
        let header = Header {
            voxels: voxels.collect(),
            ..header
        };
        Writer::new(header.clone())?;
        let slice = header.slice_voxels as usize;
        let mut geometry = Vec::new();
        for (role, level) in levels.enumerate() {
            let (name, count) = (format!("geometry of level {level}"), header.voxels[role]);
            let code = |map: &KernelMap, n: u8| codec::encode_level(model.isa(), &octree, map, n, slice);
            let coded = log.step(name, count as usize, "voxels", || {
                if role > 0 {
                    return Ok(vec![(level, code(&maps[role - 1], level))]);
                }
                let mut map = KernelMap::root();
                let above = (1..=level).map(|n| {
                    let coded = code(&map, n);
                    map = octree.child_map(n - 1, &map);
                    (n, coded)
                });
                Ok(above.collect())
            })?;
            geometry.push(coded);
        }
        Ok(Skeleton {
            model,
            header,
            octree,
            maps,
            geometry,
        })
    }

    /// Codes latents along it, level by level.
    ///
    /// # Errors
    /// Those of [`Latents`] and of [`Correct`].
    pub fn code(&self, latents: &mut Latents<'_>, mut correct: Option<&mut Correct<'_>>, log: &Log) -> Result<Coded> {
        let (octree, model) = (&self.octree, self.model);
        let (base, slice) = (self.header.base, self.header.slice_voxels as usize);
        let levels = base..=self.header.top;
        let head = |level: u8| {
            let role = usize::from(level - base);
            model.shape().head(role, Heads::Best)
        };
        let finest = levels.clone().rev().find(|level| head(*level).is_some());
        let mut coded = Coded {
            levels: Vec::new(),
            features: Vec::new(),
            left: Vec::new(),
        };
        let mut latent_bytes = 0;
        for (role, level) in levels.enumerate() {
            let (count, map) = (octree.level(level).len(), &self.maps[role]);
            let mut own = CodedLevel::default();
            let name = format!("features of level {level}");
            coded.features = log.step(name, count, "voxels", || {
                let below = &coded.features;
                let context = (role > 0).then(|| model.upsample(role, below, octree.occupancy(level - 1)));
                let context = context.as_deref();
                if !model.has_latents(role) {
                    return Ok(model.reconstruct(role, &[], context, map));
                }
                let parameters = context.map(|c| model.entropy_parameters(role, c, map));
                let (tables, voxels) = (model.tables(), octree.level(level));
                let octants = voxels.octants();
                let predict = model
                    .has_passes(role)
                    .then(|| model.passes(role, &octants, map, parameters.as_ref()));
                let coding = match (&predict, &parameters) {
                    (Some(predict), _) => Coding::Passes {
                        keys: voxels.keys(),
                        predict,
                    },
                    (None, Some((mu, sigma))) => Coding::Known(Condition::Gauss { mu, sigma }),
                    (None, None) => Coding::Known(Condition::Prior),
                };
                let latents = latents(role, coding, context)?;
                let slices = coding.encode(tables, &latents, slice);
                latent_bytes += slices.iter().map(Vec::len).sum::<usize>();
                own.features = Some((latent_hash(&latents), slices));
                Ok(model.reconstruct(role, &latents, context, map))
            })?;
            if let (Some(correct), Some(head)) = (&mut correct, head(level)) {
                let name = format!("colours of level {level}");
                let found = log.step(name, count, "voxels", || {
                    correct(Level {
                        role,
                        level,
                        finest: Some(level) == finest,
                        children: head.children,
                        octree,
                        maps: &self.maps,
                        features: &coded.features,
                        latents: latent_bytes,
                    })
                })?;
                own.filters = found.filters;
                coded.left.extend(found.left);
            }
            coded.levels.push(own);
        }
        Ok(coded)
    }

    /// The stream of what was coded along it, with residuals of some levels, which have these payloads.
    ///
    /// # Errors
    /// Those of [`Writer`].
    pub fn stream(&self, coded: &Coded, residuals: &[(u8, Vec<Vec<u8>>)]) -> Result<Vec<u8>> {
        let mut writer = Writer::new(self.header.clone())?;
        let levels = (self.header.base..).zip(self.geometry.iter().zip(&coded.levels));
        for (level, (geometry, own)) in levels {
            for (n, slices) in geometry {
                writer.geometry(*n, slices)?;
            }
            if let Some((hash, slices)) = &own.features {
                writer.features(level, *hash, slices)?;
            }
            for (heads, filter) in &own.filters {
                writer.filter(level, *heads as usize, &filter.to_bytes())?;
            }
            for (_, slices) in residuals.iter().filter(|(of, _)| *of == level) {
                writer.residual(level, slices)?;
            }
        }
        writer.finish()
    }
}
