//! The stream of what was coded.

use std::sync::Arc;

use super::EncoderInput;
use super::shape::Shape;
use crate::container::Writer;
use crate::error::Result;
use crate::gaussians::HeadMap;

/// A stream that has not been checked yet.
pub(super) struct Coded {
    pub bytes: Vec<u8>,
    pub top: u8,
    /// Its geometry, unless that is exact.
    pub shape: Option<Arc<Shape>>,
    /// The colours of the finest level, filtered.
    pub colours: Vec<[u8; 3]>,
    /// Those of the level above before its filter, as heads read them.
    pub colours_above: Vec<[u8; 3]>,
    /// The step of luma that heads go by, in 255ths.
    pub luma_step: f32,
    /// Last level and payload of the colour trunk.
    pub trunk: (u8, Vec<u8>),
    pub layers: Vec<Layer>,
}

/// The colours of a level in a stream.
pub(super) struct Layer {
    pub level: u8,
    pub hash: u64,
    pub filter: Option<Vec<u8>>,
    pub head_map: Option<HeadMap>,
    pub slices: Vec<(u32, Vec<u8>)>,
}

impl EncoderInput<'_> {
    /// Bytes of the geometry of the levels 1 to `level`, which may have a shape.
    pub(super) fn geometry_bytes(&self, level: u8, shape: Option<&Shape>) -> usize {
        let exact = usize::from(level) - usize::from(shape.is_some());
        let last = shape.into_iter().flat_map(|shape| &shape.geometry);
        let levels = self.geometry[..exact].iter().flatten();
        levels.chain(last).map(|(_, bytes)| bytes.len()).sum()
    }

    /// The stream of what was coded.
    pub(super) fn written(&self, coded: &Coded) -> Result<Vec<u8>> {
        let header = self.header(coded.top, |level| {
            self.octree(coded.shape.as_deref()).level(level).len()
        });
        let base = header.base;
        let mut writer = Writer::new(header)?;
        self.write(&mut writer, base, coded)?;
        writer.finish()
    }

    /// Writes the sections of all levels.
    fn write(&self, writer: &mut Writer, base: u8, coded: &Coded) -> Result<()> {
        let Coded {
            trunk, layers, shape, ..
        } = coded;
        let (trunk, payload) = (trunk.0, &trunk.1);
        let slice = self.options.slice_voxels as usize;
        let voxels = |level: usize| self.octree.level(level as u8).len();
        // Levels of one slice each.
        let small = (1..=usize::from(base)).take_while(|level| voxels(level - 1) <= slice);
        let small = small.count();
        let geometry = |level: u8| match shape {
            Some(shape) if level == coded.top => &shape.geometry,
            _ => &self.geometry[usize::from(level) - 1],
        };
        let levels = (1..=small).flat_map(|level| geometry(level as u8));
        let levels: Vec<_> = levels.map(|(count, bytes)| (*count, bytes)).collect();
        writer.geometry_trunk(&levels)?;
        let rest = small + 1..=usize::from(base);
        for level in rest {
            writer.geometry(level as u8, geometry(level as u8))?;
        }
        for layer in layers {
            let level = layer.level;
            if level > base {
                writer.geometry(level, geometry(level))?;
            }
            if level == trunk {
                let hash = layers[usize::from(base - trunk)].hash;
                writer.colour_trunk(level, voxels(level.into()) as u32, hash, payload)?;
            } else {
                let hash = (level > base).then_some(layer.hash);
                writer.colours(level, hash, &layer.slices)?;
            }
            if let Some(filter) = &layer.filter {
                writer.post_filter(level, filter)?;
            }
            if let Some(map) = &layer.head_map {
                writer.head_map(level, map.thickness(), &map.to_bytes())?;
            }
        }
        Ok(())
    }
}

/// Payloads with the numbers of their parents.
pub(super) fn counted(parents: usize, slice: usize, payloads: Vec<Vec<u8>>) -> Vec<(u32, Vec<u8>)> {
    let count = |i: usize| (parents - i * slice).min(slice) as u32;
    let payloads = payloads.into_iter().enumerate();
    payloads.map(|(i, bytes)| (count(i), bytes)).collect()
}
