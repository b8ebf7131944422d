//! `--resume` of a sequence: groups that a run has coded are kept until the sequence is complete.
//!
//! They are sequences of one group in `.b2p/NAME.groups` beside the output. A name is a hash of all that a group depends
//! on: this program, the options, the grid, and the contents of its clouds.

use std::collections::BTreeSet;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

use b2p::{Error, KeptGroups, output};
use xxhash_rust::xxh3::Xxh3;

use super::super::manners;
use super::super::many::record;

/// The folder of kept groups.
#[derive(Debug)]
pub struct Kept {
    folder: PathBuf,
    files: Vec<PathBuf>,
    /// What all groups depend on.
    common: String,
    /// Frames that this run has coded.
    coded: Mutex<BTreeSet<u64>>,
    warned: AtomicBool,
}

impl Kept {
    /// Of a sequence of these clouds on this grid; none without `--resume`, or if the output has no place.
    pub fn of(output: &Path, files: &[PathBuf], grid: &str) -> Option<Kept> {
        if !manners::resumes() || manners::is_pipe(output) {
            return None;
        }
        let mut name = output.file_name()?.to_owned();
        name.push(".groups");
        Some(Kept {
            folder: output.with_file_name(".b2p").join(name),
            files: files.to_vec(),
            common: format!("{:?} {:?} {grid}", record::program(), record::options()),
            coded: Mutex::default(),
            warned: AtomicBool::new(false),
        })
    }

    /// How many of `count` frames this run has not coded.
    pub fn frames_before(&self, count: u64) -> u64 {
        count - self.coded.lock().unwrap_or_else(PoisonError::into_inner).len() as u64
    }

    /// Removes them: the sequence is complete.
    pub fn remove(&self) {
        // What is left harms nothing, and is found by the next run.
        let _ = std::fs::remove_dir_all(&self.folder);
    }

    /// Where a group is kept; none if one of its clouds cannot be read.
    fn path(&self, frames: Range<u64>, settings: &str) -> Option<PathBuf> {
        let mut hash = Xxh3::new();
        hash.update(format!("{} {settings} {frames:?}", self.common).as_bytes());
        for file in self.files.get(frames.start as usize..frames.end as usize)? {
            hash.update(record::content_hash(file)?.1.as_bytes());
        }
        Some(self.folder.join(format!("{:032x}.b2p", hash.digest128())))
    }

    fn write(&self, path: &Path, sequence: &[u8]) -> b2p::Result<()> {
        let fail = |source| Error::Io {
            path: path.to_owned(),
            source,
        };
        std::fs::create_dir_all(&self.folder).map_err(fail)?;
        output::write_file(path, |w| w.write_all(sequence).map_err(fail))
    }
}

impl KeptGroups for Kept {
    fn find(&self, frames: Range<u64>, settings: &str) -> Option<Vec<u8>> {
        std::fs::read(self.path(frames, settings)?).ok()
    }

    fn keep(&self, frames: Range<u64>, settings: &str, sequence: &[u8]) {
        let mut coded = self.coded.lock().unwrap_or_else(PoisonError::into_inner);
        coded.extend(frames.clone());
        drop(coded);
        let Some(path) = self.path(frames, settings) else {
            return;
        };
        if let Err(error) = self.write(&path, sequence)
            && !self.warned.swap(true, Ordering::Relaxed)
        {
            manners::warn(&format!("coded groups are not kept: {error}"));
        }
    }
}
