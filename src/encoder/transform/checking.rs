//! Decodes what was coded, and compares, before a stream is given out. Head maps are made meanwhile, as they need what
//! decoders draw.

use super::reference::{Reference, closed};
use super::writing::Coded;
use super::{EncoderInput, Outline, head_maps, surfel_size, thickness};
use crate::container::Header;
use crate::decoder::{Decoder, Decoding};
use crate::encoder::{Encoded, rates};
use crate::error::{Error, Result};
use crate::gaussians::learned::HeadsModel;
use crate::gaussians::{Gaussians, HeadMap};
use crate::geometry::Octree;
use crate::limits::Limits;
use crate::log::Log;
use crate::renderer::Image;

/// What levels are compared with for head maps.
struct References {
    /// Of the levels above the cloud's own.
    cloud: Reference,
    /// Of the cloud's own level, where surfels may have another size.
    own: Vec<Image>,
    /// The cloud as surfels, if Gaussians are to reach as far.
    outline: Option<Gaussians>,
}

impl EncoderInput<'_> {
    /// The stream, once it has been decoded to what was encoded; if asked for with head maps, if the stream has
    /// at most `most` bytes with them.
    pub(super) fn checked(&self, mut coded: Coded, head_maps: bool, most: usize, log: &Log) -> Result<Encoded> {
        let top = coded.top;
        let shape = coded.shape.clone();
        let octree = self.octree(shape.as_deref());
        let voxels = octree.level(top);
        let decoder = Decoder::new().with_isa(self.isa).with_limits(Limits::unlimited());
        let mut decoding = decoder.with_level(top).start();
        decoding.push(&coded.bytes);
        let heads = self.options.heads.as_ref();
        let mut references = match heads.filter(|_| head_maps && self.has_head_maps(top)) {
            Some(heads) => {
                decoding.set_heads_model(heads.clone());
                Some(self.references(top, heads, log)?)
            }
            None => None,
        };
        let mut maps = Vec::new();
        let same = log.step("decode again", voxels.len(), "voxels", || {
            while let Some(level) = decoding.advance()? {
                if let Some(references) = &mut references {
                    let map = self.compared_map(octree, references, &mut decoding, level)?;
                    maps.extend(map.map(|map| (level, map)));
                }
            }
            let points = decoding.points();
            Ok(points.is_some_and(|points| points.voxels == voxels && points.colours == coded.colours))
        })?;
        if !same {
            return Err(Error::Usage(
                "the stream does not decode to what was encoded: this machine computes wrongly".into(),
            ));
        }
        for (level, map) in maps {
            if let Some(layer) = coded.layers.iter_mut().find(|layer| layer.level == level) {
                layer.head_map = Some(map);
            }
        }
        let mapped = self.written(&coded)?;
        if mapped.len() <= most {
            coded.bytes = mapped;
        }
        let bytes = coded.bytes;
        let rates = rates(&Header::parse(&bytes, &Limits::unlimited())?);
        Ok(Encoded { bytes, rates })
    }

    /// Draws what the levels down to `top` are compared with.
    fn references(&self, top: u8, heads: &HeadsModel, log: &Log) -> Result<References> {
        let levels = *self.levels.start().min(&top)..=top;
        let (count, depth) = (self.cloud.voxels.len(), self.cloud.voxels.depth());
        let cloud = log.step("draw the cloud", count, "voxels", || {
            let levels = levels.filter(|level| self.has_head_map(*level) && *level < depth);
            Reference::new(self.isa, self.cloud, self.sparse, levels)
        })?;
        let own = match top == depth && !self.sparse {
            true => log.step("draw the cloud with heads", count, "voxels", || {
                surfel_size::pictures(self.isa, self.cloud, heads)
            })?,
            false => None,
        };
        let outline = match self.options.outline {
            Outline::Surface => None,
            Outline::Cloud => Some(closed(self.isa, self.cloud, self.sparse)?),
        };
        Ok(References {
            cloud,
            own: own.unwrap_or_default(),
            outline,
        })
    }

    /// The head map of the level that was decoded, if there is something to compare it with.
    fn compared_map(
        &self,
        octree: &Octree,
        references: &mut References,
        decoding: &mut Decoding<'_>,
        level: u8,
    ) -> Result<Option<HeadMap>> {
        if !self.has_head_map(level) {
            return Ok(None);
        }
        let References { cloud, own, outline } = references;
        let pictures = match level == self.cloud.voxels.depth() {
            true => own,
            false => cloud.pictures(level),
        };
        if pictures.is_empty() {
            return Ok(None);
        }
        let map = match self.maps_blocks(level) {
            true => head_maps::of_level(octree, cloud, decoding, level)?,
            false => surfel_size::of_level(self.isa, octree, pictures, decoding, level)?,
        };
        match outline {
            None => Ok(Some(map)),
            Some(outline) => thickness::of_level(self.isa, map, outline, decoding, level).map(Some),
        }
    }
}
