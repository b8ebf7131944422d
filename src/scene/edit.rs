//! Coarser scenes of scenes, without coding anything again.

use super::reader::SceneReader;
use super::source::Source;
use crate::container::Header;
use crate::container::scene::{BlockEntry, write_index};
use crate::error::Result;
use crate::limits::Limits;

impl<S: Source> SceneReader<S> {
    /// The scene down to a level: every block is cut after it, and says so.
    ///
    /// # Errors
    /// [`Error::Usage`](crate::Error::Usage) if the scene has no such level, and those of [`SceneReader::block`].
    pub fn cut(&self, level: u8) -> Result<Vec<u8>> {
        self.header().voxels(level)?;
        let mut entries = Vec::new();
        for block in 0..self.blocks().len() {
            entries.push(BlockEntry::of(
                self.blocks()[block].cube,
                &self.cut_block(block, level)?,
            )?);
        }
        let mut common = self.header().clone();
        common.top = level;
        let mut scene = write_index(&common, &entries)?;
        for block in 0..self.blocks().len() {
            scene.extend(self.cut_block(block, level)?);
        }
        Ok(scene)
    }

    /// The stream of a block down to a level of the scene.
    fn cut_block(&self, block: usize, level: u8) -> Result<Vec<u8>> {
        let bytes = self.block(block)?;
        let header = Header::parse(&bytes, &Limits::unlimited())?;
        let top = level - self.blocks()[block].cube.level;
        let levels = usize::from(top - header.base) + 1;
        let (start, end) = (header.bytes(), header.prefix_bytes(top)? as usize);
        let cut = Header {
            top,
            voxels: header.voxels[..levels].to_vec(),
            sections: header.sections[..levels].to_vec(),
            ..header
        };
        // The hash of the block holds that it is whole.
        Ok([cut.write(), bytes.get(start..end).unwrap_or_default().to_vec()].concat())
    }
}
