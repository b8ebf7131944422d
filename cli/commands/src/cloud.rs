//! Point clouds in: of any format, with what was mended; and as surfels to draw.

use std::io::Read;
use std::path::Path;

use b2p::axes::{Axes, Up};
use b2p::cloud::{
    ColourRange, ColouredVoxels, GridReport, Note, PointCloud, ReadOptions, voxelise, voxelise_closed, voxelise_memory,
};
use b2p::container;
use b2p::gaussians::surfels::{PerVoxel, SurfelSelection, surfels};
use b2p::gaussians::{Frame, Gaussians};
use b2p::geometry::Octree;
use b2p::log::Log;
use b2p::{Isa, Limits};
use b2p_formats::clouds::{self, Encoded, PointFormat, Reading, WriteOptions};
use b2p_formats::detect::{Group, Kind};
use b2p_formats::sidecar::Sidecar;
use clap::Args;
use serde_json::json;

use super::table::count;
use super::{Failure, Result, load, manners};

/// Voxels of the finest level for one of the level above from which on surfaces are closed at the finest level.
const CLOSED: usize = 3;
/// Share of a stream, one in so many bytes, that a coordinate system may take.
const CRS_SHARE: f64 = 20.0;
/// Bytes that tell the kind of a file.
const START: u64 = 1 << 18;

/// How points are read.
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Points")]
pub struct ReadArgs {
    /// Keep only the points in a box: its lowest and its highest corner
    #[arg(long, value_name = "X0,Y0,Z0,X1,Y1,Z1", value_parser = corners, allow_hyphen_values = true)]
    pub crop: Option<[[f64; 3]; 2]>,
    /// Leave out points far from all others
    #[arg(long)]
    pub drop_outliers: bool,
    /// Leave out points that cannot be seen from outside, such as what closed surfaces surround
    #[arg(long)]
    pub drop_hidden: bool,
    /// Refuse points that are not finite, colours whose range must be guessed, and points without colours
    #[arg(long)]
    pub strict: bool,
    /// Value of the colours that is white: 1, 255 or 65535 [default: by their type and maximum]
    #[arg(long, value_name = "MAX")]
    pub colour_range: Option<ColourRange>,
    /// Axis that points up: x, y, z, -x, -y, -z, or auto [default: what the file or its format says]
    #[arg(long, value_name = "AXIS", value_parser = up, allow_hyphen_values = true)]
    pub up: Option<UpArg>,
    /// Length of a unit: m, cm, mm, km, in, ft, us-ft, or a number of metres [default: what the file or its format
    /// says]
    #[arg(long, value_name = "UNIT", value_parser = unit)]
    pub unit: Option<f64>,
    /// Take the vertices of a mesh as points
    #[arg(long)]
    pub vertices: bool,
}

/// An axis, or what the file says.
#[derive(Debug, Clone, Copy)]
pub struct UpArg(Option<Up>);

impl UpArg {
    /// The axis. `None` for what the file says.
    pub fn up(self) -> Option<Up> {
        self.0
    }
}

/// How points are written.
#[derive(Debug, Clone, Copy, Default, Args)]
#[command(next_help_heading = "Points")]
pub struct WriteArgs {
    /// Write points with coordinates as doubles [default: floats where they are exact]
    #[arg(long, requires = "points")]
    pub double: bool,
    /// Write points with coordinates from the grid's origin, which goes into a comment and into OUT.json
    #[arg(long, requires = "points")]
    pub local: bool,
}

/// An axis, or `auto`.
pub fn up(text: &str) -> std::result::Result<UpArg, String> {
    match text {
        "auto" => Ok(UpArg(None)),
        _ => text
            .parse()
            .map(|up| UpArg(Some(up)))
            .map_err(|e: b2p::Error| e.to_string()),
    }
}

fn unit(text: &str) -> std::result::Result<f64, String> {
    Axes::parse_unit(text).map_err(|e| e.to_string())
}

pub fn corners(text: &str) -> std::result::Result<[[f64; 3]; 2], String> {
    let expected = "expected six numbers, the lowest corner and the highest, such as -1,-1,0,1,1,2";
    let numbers: Option<Vec<f64>> = text.split(',').map(|t| t.trim().parse().ok()).collect();
    match numbers.as_deref() {
        Some(&[a, b, c, d, e, f]) if a <= d && b <= e && c <= f => Ok([[a, b, c], [d, e, f]]),
        _ => Err(expected.into()),
    }
}

impl ReadArgs {
    /// The first option that was given and concerns points alone.
    pub fn given(&self) -> Option<&'static str> {
        let all = [
            ("--crop", self.crop.is_some()),
            ("--drop-outliers", self.drop_outliers),
            ("--drop-hidden", self.drop_hidden),
            ("--strict", self.strict),
            ("--colour-range", self.colour_range.is_some()),
            ("--unit", self.unit.is_some()),
            ("--vertices", self.vertices),
        ];
        all.iter().find(|(_, given)| *given).map(|(name, _)| *name)
    }

    fn options(&self) -> ReadOptions {
        ReadOptions {
            strict: self.strict,
            colour_range: self.colour_range,
            crop: self.crop,
            drop_outliers: self.drop_outliers,
            drop_hidden: self.drop_hidden,
            up: self.up.and_then(|up| up.0),
            metres_per_unit: self.unit,
            vertices: self.vertices,
            offset: [0.0; 3],
        }
    }
}

/// Reads the points of a file, and says on standard error what was mended.
pub fn read(path: &Path, args: &ReadArgs, limits: &Limits) -> Result<PointCloud> {
    of_bytes(path, load::bytes(path, limits)?, args, limits)
}

/// Reads the points of a file with these bytes, and says on standard error what was mended.
pub fn of_bytes(path: &Path, bytes: Vec<u8>, args: &ReadArgs, limits: &Limits) -> Result<PointCloud> {
    let read = reading(path, bytes, &args.options(), limits)?;
    say(path, &read.notes);
    Ok(read.cloud)
}

/// Reads points, with what stands in a file beside.
fn reading(path: &Path, bytes: Vec<u8>, options: &ReadOptions, limits: &Limits) -> Result<Reading> {
    let folder = path
        .parent()
        .filter(|folder| *folder != Path::new(""))
        .unwrap_or(Path::new("."));
    let beside = Sidecar::beside(path);
    let options = beside
        .as_ref()
        .map_or_else(|| options.clone(), |beside| beside.options(options));
    let read = clouds::read(bytes, Some(folder), limits, &options);
    let mut read = read.map_err(Failure::in_file(path))?;
    if let Some(beside) = beside {
        beside.complete(&mut read.cloud);
        let (contents, name) = (beside.contents(), Sidecar::path_of(path));
        read.notes
            .push(Note::Other(format!("{contents}: as {} states", name.display())));
    }
    Ok(read)
}

/// Reads a piece of a file's points, whose bytes are a file of their own, with colours of a known range.
pub fn piece(
    path: &Path,
    bytes: Vec<u8>,
    args: &ReadArgs,
    range: Option<ColourRange>,
    limits: &Limits,
) -> Result<Reading> {
    let options = ReadOptions {
        colour_range: range,
        ..args.options()
    };
    let read = clouds::read(bytes, None, limits, &options);
    read.map_err(Failure::in_file(path))
}

fn say(path: &Path, notes: &[Note]) {
    for note in notes {
        manners::warn(&format!("{}: {note}", path.display()));
    }
}

/// Fails unless so many points may be voxelised.
fn check_memory(points: usize, limits: &Limits) -> b2p::Result<()> {
    limits.check_bytes("bytes of a cloud and its voxels", voxelise_memory(points as u64))
}

/// The voxels of a cloud, of this depth or by the spacing of its points.
pub fn grid(cloud: &PointCloud, bits: Option<u8>, limits: &Limits) -> b2p::Result<(ColouredVoxels, GridReport)> {
    check_memory(cloud.positions.len(), limits)?;
    match bits {
        None => voxelise_closed(cloud),
        Some(bits) => {
            let grid = voxelise(cloud, Some(bits))?;
            let report = GridReport::of(&grid, cloud.positions.len(), &cloud.axes, bits);
            Ok((grid, report))
        }
    }
}

/// What a user should know of the grid.
pub fn describe(report: &GridReport) -> String {
    let mut text = format!("{report}\n");
    let (bits, finest) = (report.bits, report.finest);
    if report.is_coarser() {
        text += &format!(
            "Using {bits} bits: at {finest}, gaps between points would show as holes. Force {finest} with --bits {finest}.\n"
        );
    }
    if report.merges_most() && bits < 21 {
        text += &format!(
            "More than half of the points share voxels with others. --bits {} keeps more of them.\n",
            bits + 1
        );
    }
    text
}

/// The axes that a stream of at most `bytes` bytes can afford to carry.
pub fn affordable(mut axes: Axes, bytes: f64) -> Axes {
    let length = axes.crs.len();
    if length as f64 > bytes / CRS_SHARE {
        manners::warn(&format!(
            "left out the coordinate system: its {length} bytes are too many at this rate"
        ));
        axes.crs.clear();
    }
    axes
}

/// The axes of the stream that starts with these bytes; unknown ones of anything else.
pub fn axes(bytes: &[u8]) -> Axes {
    container::axes(bytes).unwrap_or_default()
}

/// The axis that points up: as asked for, or as the input says.
pub fn up_of(asked: Option<UpArg>, known: &Axes) -> Option<Up> {
    asked.and_then(UpArg::up).or(known.up)
}

/// The first bytes of a regular file, enough to know its kind. What is read from a pipe would be missing afterwards.
fn start_of(path: &Path) -> Option<Vec<u8>> {
    let is_file = std::fs::metadata(path).is_ok_and(|data| data.is_file());
    let file = std::fs::File::open(path).ok().filter(|_| is_file)?;
    let mut start = Vec::new();
    file.take(START).read_to_end(&mut start).ok()?;
    Some(start)
}

/// Refuses a file of points where a stream is expected.
pub fn refuse(path: &Path) -> Result<()> {
    match start_of(path) {
        Some(start) if is_cloud(&start) => Err(Failure(format!(
            "{}: this is {}, not a b2p stream: code it with `b2p encode`, or draw it with `b2p render`",
            path.display(),
            clouds::describe(&start)
        ))),
        _ => Ok(()),
    }
}

/// Whether a file with these bytes is read as points to be drawn. `bytes` may be its start.
pub fn is_cloud(bytes: &[u8]) -> bool {
    let kind = Kind::of(bytes);
    kind.group() == Group::Cloud || matches!(kind, Kind::Obj | Kind::Glb | Kind::Gltf)
}

/// Points as surfels, and what is known of their coordinates.
pub fn surfels_of(
    path: &Path,
    bytes: Vec<u8>,
    args: &ReadArgs,
    isa: Isa,
    limits: &Limits,
    log: &Log,
) -> Result<(Gaussians, Axes)> {
    let fail = Failure::in_file(path);
    let cloud = log.step("read cloud", 1, "file", || Ok(of_bytes(path, bytes, args, limits)))??;
    let points = cloud.positions.len();
    check_memory(points, limits).map_err(&fail)?;
    let grid = log
        .step("voxelise", points, "points", || closed(&cloud))
        .map_err(&fail)?;
    let frame = Frame {
        bits: grid.voxels.depth(),
        placement: grid.placement,
    };
    let gaussians = log.step("surfels", grid.voxels.len(), "voxels", || -> b2p::Result<Gaussians> {
        let octree = Octree::new(grid.voxels)?;
        let depth = octree.depth();
        let map = octree.sibling_map(depth);
        Ok(surfels(
            isa,
            octree.level(depth),
            &map,
            &grid.colours,
            PerVoxel::One,
            SurfelSelection::ALL,
            frame,
        ))
    });
    Ok((gaussians.map_err(&fail)?, cloud.axes))
}

/// Voxels of the finest level at which surfaces are closed: the grid's own, or the level above.
fn closed(cloud: &PointCloud) -> b2p::Result<ColouredVoxels> {
    let (grid, report) = voxelise_closed(cloud)?;
    let above = grid.voxels.parents();
    if grid.voxels.len() >= CLOSED * above.len() || report.bits < 2 {
        return Ok(grid);
    }
    voxelise(cloud, Some(report.bits - 1))
}

/// What a file of points holds, as text or JSON. `None` if it is none.
pub fn info(path: &Path, bytes: &[u8], as_json: bool, limits: &Limits) -> Result<Option<String>> {
    if !is_cloud(bytes) {
        return Ok(None);
    }
    let fail = Failure::in_file(path);
    let read = reading(path, bytes.to_vec(), &ReadOptions::default(), limits)?;
    let cloud = &read.cloud;
    check_memory(cloud.positions.len(), limits).map_err(&fail)?;
    let (grid, report) = voxelise_closed(cloud).map_err(&fail)?;
    let mut corners = [[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]];
    for position in &cloud.positions {
        for (axis, x) in position.iter().enumerate() {
            corners[0][axis] = corners[0][axis].min(*x);
            corners[1][axis] = corners[1][axis].max(*x);
        }
    }
    let format = clouds::describe(bytes);
    let notes: Vec<String> = read.notes.iter().map(ToString::to_string).collect();
    let axes = &cloud.axes;
    if as_json {
        let object = json!({
            "format": format,
            "points": cloud.positions.len(),
            "lowest": corners[0],
            "highest": corners[1],
            "up": axes.up.map(|up| up.to_string()),
            "metres_per_unit": axes.metres_per_unit,
            "crs": axes.crs,
            "grid": { "bits": report.bits, "voxels": grid.voxels.len(), "voxel_size": report.voxel_size },
            "notes": notes,
        });
        return Ok(Some(format!("{object:#}\n")));
    }
    let [low, high] = corners;
    let mut text = format!(
        "{format}, {} points\nfrom {low:?} to {high:?}\n{}",
        count(cloud.positions.len() as u64),
        described(axes)
    );
    for note in notes {
        text += &format!("{note}\n");
    }
    Ok(Some(format!("{text}as a stream: {report}\n")))
}

/// What is known of coordinates, a line for each.
pub fn described(axes: &Axes) -> String {
    let mut text = String::new();
    if let Some(up) = axes.up {
        text += &format!("{up} points up\n");
    }
    if let Some(unit) = axes.unit_name() {
        text += &format!("unit of length: {unit}\n");
    }
    if !axes.crs.is_empty() {
        text += &format!("coordinate system: {}\n", axes.crs);
    }
    text
}

/// Points as a file of the format that its ending names, PLY for any other.
pub fn encoded(voxels: &ColouredVoxels, axes: &Axes, path: &Path, args: WriteArgs) -> b2p::Result<Encoded> {
    let WriteArgs { double, local } = args;
    let format = PointFormat::of(path).unwrap_or(PointFormat::Ply);
    clouds::encode(voxels, axes, format, WriteOptions { double, local })
}
