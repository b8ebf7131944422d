//! More points than fit into memory, in Morton order: sorted runs in temporary files, merged as they are read.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::fs::{File, OpenOptions};
use std::io::{BufReader, BufWriter, ErrorKind, Read, Seek, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use super::encoder::Voxel;
use crate::error::{Error, Result};

/// Bytes of a point in a run: its key and its colour.
const POINT: usize = 8 + 3;
/// Bytes that are read of a run at a time.
const BUFFER: usize = 1 << 18;

/// Tells temporary files of one process apart.
static NUMBER: AtomicU64 = AtomicU64::new(0);

/// Sorted runs of points in files that nobody else sees.
#[derive(Debug)]
pub struct Runs {
    folder: PathBuf,
    runs: Vec<Run>,
}

/// A temporary file, which is gone when it is closed.
#[derive(Debug)]
struct Run {
    file: File,
    path: PathBuf,
    points: u64,
}

impl Drop for Run {
    fn drop(&mut self) {
        // On Unix it has no name any more.
        let _ = std::fs::remove_file(&self.path);
    }
}

impl Runs {
    /// No runs yet, whose files will be in this folder.
    pub fn new(folder: &Path) -> Self {
        Runs {
            folder: folder.to_path_buf(),
            runs: Vec::new(),
        }
    }

    /// Number of points.
    pub fn points(&self) -> u64 {
        self.runs.iter().map(|run| run.points).sum()
    }

    /// Adds points, sorted by their keys; several may have one key.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn add(&mut self, points: &[Voxel]) -> Result<()> {
        debug_assert!(points.is_sorted_by_key(|point| point.0));
        let (file, path) = temporary(&self.folder)?;
        let run = Run {
            file,
            path,
            points: points.len() as u64,
        };
        let write = || -> std::io::Result<()> {
            let mut writer = BufWriter::with_capacity(BUFFER, &run.file);
            for (key, colour) in points {
                let mut bytes = [0; POINT];
                bytes[..8].copy_from_slice(&key.to_le_bytes());
                bytes[8..].copy_from_slice(colour);
                writer.write_all(&bytes)?;
            }
            writer.flush()
        };
        write().map_err(|source| io_error(&run.path, source))?;
        self.runs.push(run);
        Ok(())
    }

    /// The voxels of all points, ascending, each with the mean colour of its points.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn voxels(&mut self) -> Result<Voxels<'_>> {
        let mut readers = Vec::new();
        for run in &mut self.runs {
            run.file.rewind().map_err(|source| io_error(&run.path, source))?;
            let (file, path) = (BufReader::with_capacity(BUFFER, &run.file), run.path.as_path());
            readers.push(Reading {
                file,
                path,
                left: run.points,
            });
        }
        let mut voxels = Voxels {
            readers,
            next: BinaryHeap::new(),
        };
        for run in 0..voxels.readers.len() {
            voxels.advance(run)?;
        }
        Ok(voxels)
    }
}

/// A run that is read.
#[derive(Debug)]
struct Reading<'a> {
    file: BufReader<&'a File>,
    path: &'a Path,
    /// Points that have not been read.
    left: u64,
}

/// Merges runs to voxels.
#[derive(Debug)]
pub struct Voxels<'a> {
    readers: Vec<Reading<'a>>,
    /// The next point of each run that has one: key, number of the run, colour.
    next: BinaryHeap<Reverse<(u64, usize, [u8; 3])>>,
}

impl Voxels<'_> {
    /// Reads the next point of a run.
    fn advance(&mut self, run: usize) -> Result<()> {
        let reading = &mut self.readers[run];
        if reading.left == 0 {
            return Ok(());
        }
        let mut bytes = [0; POINT];
        let read = reading.file.read_exact(&mut bytes);
        read.map_err(|source| io_error(reading.path, source))?;
        reading.left -= 1;
        let (key, colour) = bytes.split_at(8);
        let key = key.iter().rev().fold(0, |key, byte| key << 8 | u64::from(*byte));
        self.next.push(Reverse((key, run, [colour[0], colour[1], colour[2]])));
        Ok(())
    }
}

impl Iterator for Voxels<'_> {
    type Item = Result<Voxel>;

    fn next(&mut self) -> Option<Self::Item> {
        let Reverse((key, ..)) = *self.next.peek()?;
        let (mut sum, mut count) = ([0u64; 3], 0u64);
        while let Some(&Reverse((other, run, colour))) = self.next.peek()
            && other == key
        {
            self.next.pop();
            count += 1;
            for (sum, value) in sum.iter_mut().zip(colour) {
                *sum += u64::from(value);
            }
            if let Err(error) = self.advance(run) {
                self.next.clear();
                return Some(Err(error));
            }
        }
        Some(Ok((key, sum.map(|sum| ((sum + count / 2) / count) as u8))))
    }
}

/// A new file in a folder, which loses its name at once where that is possible.
fn temporary(folder: &Path) -> Result<(File, PathBuf)> {
    loop {
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        let path = folder.join(format!(".b2p-{}-{number}.run", std::process::id()));
        match OpenOptions::new().read(true).write(true).create_new(true).open(&path) {
            Ok(file) => {
                #[cfg(unix)]
                std::fs::remove_file(&path).map_err(|source| io_error(&path, source))?;
                return Ok((file, path));
            }
            // That of a process that was killed.
            Err(error) if error.kind() == ErrorKind::AlreadyExists => {}
            Err(source) => return Err(io_error(&path, source)),
        }
    }
}

fn io_error(path: &Path, source: std::io::Error) -> Error {
    let path = path.to_path_buf();
    Error::Io { path, source }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]

        #[test]
        fn runs_are_merged_to_voxels_with_the_mean_of_all_their_points(
            runs in prop::collection::vec(prop::collection::vec((0u64..40, any::<[u8; 3]>()), 0..60), 0..6),
        ) {
            let folder = tempfile::tempdir().unwrap();
            let mut sorted = Runs::new(folder.path());
            for mut run in runs.clone() {
                run.sort_by_key(|point| point.0);
                sorted.add(&run).unwrap();
            }
            let mut all: Vec<Voxel> = runs.concat();
            prop_assert_eq!(sorted.points(), all.len() as u64);
            all.sort_by_key(|point| point.0);
            let mean = |same: &[Voxel]| {
                let count = same.len() as u64;
                let sum = |c: usize| same.iter().map(|point| u64::from(point.1[c])).sum::<u64>();
                (same[0].0, [0, 1, 2].map(|c| ((sum(c) + count / 2) / count) as u8))
            };
            let expected: Vec<Voxel> = all.chunk_by(|a, b| a.0 == b.0).map(mean).collect();
            for _ in 0..2 {
                let found = sorted.voxels().unwrap().collect::<Result<Vec<_>>>().unwrap();
                prop_assert_eq!(&found, &expected);
            }
            drop(sorted);
            prop_assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
        }
    }
}
