//! `b2p encode` of a cloud that does not fit into memory: it is read piece by piece, and sorted on disk.

use b2p::cloud::{ColourRange, CommonGrid, GridNeed, Note, PointCloud, voxelise_memory};
use b2p::encoder::transform::{Options, surface_within};
use b2p::scene::{BLOCK_VOXELS, Grid, Runs};
use b2p::{Error, Limits, SceneEncoder};
use b2p_formats::clouds::Pieces;

use super::super::args::{Colours, Encode};
use super::super::manners::{self, Said};
use super::super::progress::Progress;
use super::super::{Failure, Result, cloud};
use super::encode::said;

/// Bytes that a point of a piece takes while it is read and sorted.
const POINT_BYTES: u64 = 128;
/// Pieces take this share of the memory that may be used.
const SHARE: u64 = 8;
/// Points of a piece at least.
const LEAST: u64 = 1 << 12;

/// Voxels of a block at least: smaller blocks take many more bits.
const LEAST_BLOCK: usize = 1 << 16;

/// Voxels of a block of which two are coded at a time within the limits.
fn block_voxels(limits: &Limits) -> usize {
    (surface_within(limits.max_bytes / 2) as usize).clamp(LEAST_BLOCK, BLOCK_VOXELS)
}

/// The pieces of a cloud, if it is to be read in pieces: it is one file, and larger than memory allows.
pub fn pieces(args: &Encode, limits: &Limits) -> Result<Option<Pieces>> {
    if manners::is_pipe(&args.cloud) || args.no_blocks || !matches!(args.colours, Colours::Transform) {
        return Ok(None);
    }
    let Ok(file) = std::fs::metadata(&args.cloud) else {
        // What is wrong is said when it is read.
        return Ok(None);
    };
    let Some(pieces) = Pieces::open(&args.cloud)? else {
        return Ok(None);
    };
    let needed = file.len().saturating_add(voxelise_memory(pieces.points()));
    Ok((needed > limits.max_bytes).then_some(pieces))
}

/// Codes a cloud in pieces as a scene.
///
/// `options` gives those of a grid with so many bits.
pub fn run(
    args: &Encode,
    pieces: Pieces,
    options: impl FnOnce(u8) -> Result<Options>,
    limits: &Limits,
    progress: &Progress,
) -> Result<Said> {
    let asked = [
        ("--crop", args.read.crop.is_some()),
        ("--drop-outliers", args.read.drop_outliers),
        ("--drop-hidden", args.read.drop_hidden),
        ("--bits-per-point", args.bits_per_point.is_some()),
    ];
    if let Some((name, _)) = asked.iter().find(|(_, asked)| *asked) {
        return Err(Failure(format!(
            "{}: {name} needs all of the cloud in memory, more than --max-memory allows",
            args.cloud.display()
        )));
    }
    manners::permit(&[&args.output], &[&args.cloud])?;
    let started = std::time::Instant::now();
    let mut cloud = InPieces::new(args, pieces, limits);
    let first = cloud.look(progress)?;
    let bits = args.bits.or(first.hints.bits).ok_or_else(|| {
        let what = "the cloud is sorted on disk, and says nothing of a grid: --bits N gives its depth";
        Failure(format!("{}: {what}", args.cloud.display()))
    })?;
    let grid = CommonGrid::new(&first, &cloud.needs, Some(bits))?;
    let axes = first.axes.clone();
    drop(first);
    let mut runs = cloud.sort(&grid, progress)?;
    let encoder = SceneEncoder::new()
        .with_options(options(grid.bits())?)
        .with_block_voxels(args.block_size.map_or(block_voxels(limits), |size| size as usize))
        .with_memory(limits.max_bytes)
        .with_axes(axes);
    let mut blocks = Vec::new();
    let mut count = 0u64;
    let mut take = |entry: &b2p::container::scene::BlockEntry, bytes: &[u8]| {
        count += u64::from(entry.points);
        progress.say(&format!("coded {count} voxels"));
        blocks.extend_from_slice(bytes);
        Ok(())
    };
    let grid = Grid {
        bits: grid.bits(),
        placement: grid.placement(),
    };
    let mut bytes = encoder.encode_voxels(grid, runs.voxels()?, &mut take)?;
    bytes.append(&mut blocks);
    let to = &args.output;
    manners::write(to, |w| {
        w.write_all(&bytes).map_err(|source| Error::Io {
            path: to.to_path_buf(),
            source,
        })
    })?;
    let said = said(args, &bytes, started.elapsed().as_secs_f64(), "", limits)?;
    Ok(said.beside(to))
}

/// A cloud that is read twice, piece by piece.
struct InPieces<'a> {
    args: &'a Encode,
    limits: &'a Limits,
    pieces: Pieces,
    /// Points of a piece.
    size: u64,
    /// What each piece asks of the grid.
    needs: Vec<GridNeed>,
    /// What white is, as the pieces so far tell.
    range: Option<ColourRange>,
}

impl<'a> InPieces<'a> {
    fn new(args: &'a Encode, pieces: Pieces, limits: &'a Limits) -> Self {
        InPieces {
            args,
            limits,
            pieces,
            size: (limits.max_bytes / SHARE / POINT_BYTES).clamp(LEAST, 1 << 24),
            needs: Vec::new(),
            range: args.read.colour_range,
        }
    }

    /// Where each piece starts.
    fn starts(&self) -> impl Iterator<Item = u64> + use<> {
        (0..self.pieces.points()).step_by(self.size as usize)
    }

    /// Reads a piece; what was mended in the first one is said.
    fn read(&mut self, start: u64, say: bool) -> Result<PointCloud> {
        let bytes = self.pieces.read(start, self.size)?;
        if self.args.read.colour_range.is_none() {
            let found = self.pieces.colour_range(&bytes);
            // One large value tells of the whole file.
            self.range = match self.range {
                Some(ColourRange::Shorts) => self.range,
                _ => found.or(self.range),
            };
        }
        let reading = cloud::piece(&self.args.cloud, bytes, &self.args.read, self.range, self.limits)?;
        if let Some(note) = reading.notes.iter().find(|note| is_of_all(note)) {
            let what = "which needs all of the cloud in memory, more than --max-memory allows";
            return Err(Failure(format!("{}: {note}, {what}", self.args.cloud.display())));
        }
        if say {
            for note in &reading.notes {
                manners::warn(&format!("{}: {note}", self.args.cloud.display()));
            }
        }
        Ok(reading.cloud)
    }

    /// Reads all pieces once, and returns the first.
    fn look(&mut self, progress: &Progress) -> Result<PointCloud> {
        let mut first = None;
        for start in self.starts() {
            progress.say(&format!("looked at {start} of {} points", self.pieces.points()));
            let piece = self.read(start, start == 0)?;
            let need = GridNeed::of(&piece).map_err(Failure::in_file(&self.args.cloud))?;
            self.needs.push(need);
            first.get_or_insert(piece);
        }
        first.ok_or_else(|| Failure(format!("{}: there are no points", self.args.cloud.display())))
    }

    /// Reads all pieces again, and sorts their points.
    fn sort(&mut self, grid: &CommonGrid, progress: &Progress) -> Result<Runs> {
        let mut runs = Runs::new(&std::env::temp_dir());
        for start in self.starts() {
            progress.say(&format!("sorted {start} of {} points", self.pieces.points()));
            let piece = self.read(start, false)?;
            runs.add(&grid.points(&piece)?)?;
        }
        Ok(runs)
    }
}

/// Whether what was mended depends on all points.
fn is_of_all(note: &Note) -> bool {
    matches!(note, Note::ColourRange { .. } | Note::Grey { .. } | Note::Shaded { .. })
}
