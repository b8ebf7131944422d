//! `b2p info`: what a stream holds.

use b2p::container::{self, Level, Scan, Section, Stream};
use b2p::latents::{ResidualSteps, Steps};
use b2p::{Axes, Limits, colour};
use serde_json::json;

use super::args::Info;
use super::manners::{self, Said};
use super::table::{count, counted, table};
use super::{Failure, Result, cloud, kinds, load, scene, sequence};

/// Describes a stream as text or JSON. A cut or damaged stream is described with what is wrong; its model is described
/// if it is the one at hand.
pub fn run(args: &Info, limits: &Limits) -> Result<Said> {
    if sequence::is_sequence(&args.input) {
        return sequence::info(&args.input, limits);
    }
    if scene::is_scene(&args.input) {
        return scene::info(&args.input, limits);
    }
    let bytes = load::bytes(&args.input, limits)?;
    if let Some(text) = cloud::info(&args.input, &bytes, manners::json(), limits)? {
        return Ok(Said::result(text));
    }
    kinds::check_stream(&args.input, &bytes)?;
    let stream = Stream::parse(&bytes, limits).map_err(Failure::in_file(&args.input))?;
    let header = stream.header();
    let at_hand = match header.model() {
        Some(_) => Some(load::from_file(args.model.as_deref())?),
        None => None,
    };
    let at_hand = at_hand.filter(|at_hand| header.check_model(&at_hand.id()).is_ok());
    let known = at_hand.map(|at_hand| {
        let shape = at_hand.shape();
        let heads: Vec<_> = shape.heads().iter().map(ToString::to_string).collect();
        (shape.name.clone(), heads)
    });
    let levels = levels(&stream)?;
    let state = State::of(&stream, bytes.len());
    let axes = cloud::axes(&bytes);
    let from = container::source_points(&bytes).ok().flatten();
    Ok(Said::result(match manners::json() {
        true => json(&stream, &bytes, &Cloud { axes, points: from }, &levels, known, &state),
        false => {
            text(args, &stream, bytes.len(), &levels, known, &state)
                + &cloud::described(&axes)
                + &merged(header.points, from)
                + &notes(&bytes, &stream)
        }
    }))
}

/// What a stream says of the cloud that it was made of.
struct Cloud {
    axes: Axes,
    /// Points before those of a voxel were merged.
    points: Option<u32>,
}

/// How many points were merged into voxels, if the stream says so. It may say anything.
fn merged(voxels: u64, points: Option<u32>) -> String {
    let Some(points) = points.map(u64::from) else {
        return String::new();
    };
    let share = match points.checked_sub(voxels) {
        Some(merged) if points > 0 => format!(", {:.1} % merged", 100.0 * merged as f64 / points as f64),
        _ => ", which cannot be".into(),
    };
    format!(
        "made of {} in {}{share}\n",
        counted(points, "point"),
        counted(voxels, "voxel")
    )
}

/// What is unusual about the stream's chunks, such as one of a later version.
fn notes(bytes: &[u8], stream: &Stream) -> String {
    let notes = Scan::new(bytes, stream.header()).notes;
    notes.iter().map(|note| format!("note: {}\n", note.text)).collect()
}

/// How much of a stream is there.
enum State {
    /// All that the header counts.
    Whole,
    /// It ends after this level: a coarser stream.
    CutAfter(u8),
    /// It ends within a level, or is damaged; complete levels may be there.
    Damaged(String),
}

impl State {
    fn of(stream: &Stream, bytes: usize) -> Self {
        let end = |level: u8| stream.header().prefix_bytes(level).ok();
        match (stream.damage(), stream.deepest()) {
            (None, _) => State::Whole,
            (Some(_), Some(level)) if end(level) == Some(bytes as u64) => State::CutAfter(level),
            (Some(damage), _) => State::Damaged(damage.to_string()),
        }
    }
}

/// Name and heads of a model.
type Known = Option<(String, Vec<String>)>;

/// What a stream says of a level. What stands in its chunks is not known of a level that is not whole.
struct Described {
    level: u8,
    voxels: u32,
    section: Section,
    /// Bytes of the stream up to its end.
    prefix: u64,
    /// Quantisation steps of the colours in version 3.
    steps: Option<colour::Steps>,
    residual: Option<usize>,
    precision: Option<ResidualSteps>,
    whole: bool,
}

fn levels(stream: &Stream) -> Result<Vec<Described>> {
    let header = stream.header();
    let counted = header.voxels.iter().zip(&header.sections);
    let levels = (header.base..).zip(counted).enumerate();
    let describe = |(i, (level, (&voxels, &section)))| {
        let found: Option<&Level> = stream.levels().get(i);
        let residual = |found: &Level| found.residual.iter().map(|slice| slice.bytes.len() + 16).sum();
        let precision = |found: &Level| ResidualSteps::read(found.residual.first()?.bytes);
        Ok(Described {
            level,
            voxels,
            section,
            prefix: header.prefix_bytes(level)?,
            steps: found.and_then(steps),
            residual: found.map(residual),
            precision: found.and_then(precision),
            whole: found.is_some(),
        })
    };
    levels.map(describe).collect()
}

/// The steps of a level of version 3.
fn steps(level: &Level) -> Option<colour::Steps> {
    let colours = level.colours.as_ref()?;
    let trunk = colours.trunk.map(|trunk| trunk.slice);
    let last = colours.levels.last().and_then(|level| level.slices.first());
    let &[luma, chroma, ..] = last.or(trunk.as_ref())?.bytes else {
        return None;
    };
    let steps = colour::Steps { luma, chroma };
    steps.is_valid().then_some(steps)
}

fn json(stream: &Stream, bytes: &[u8], cloud: &Cloud, levels: &[Described], known: Known, state: &State) -> String {
    let header = stream.header();
    let notes = Scan::new(bytes, header).notes;
    let notes: Vec<_> = notes.into_iter().map(|note| note.text).collect();
    let level = |of: &Described| {
        json!({
            "level": of.level,
            "voxels": of.voxels,
            "geometry_bytes": of.section.geometry,
            "colour_bytes": of.section.colours,
            "geometry_bits_per_point": bits(of.section.geometry.into(), header.points),
            "colour_bits_per_point": bits(of.section.colours.into(), header.points),
            "luma_step": of.steps.map(|steps| steps.luma_step()),
            "lossless": of.steps.map(|steps| steps.is_lossless()),
            "residual_bytes": of.residual,
            "residual_steps": of.precision.map(|told| json!({
                "fine": [told.fine.luma, told.fine.chroma],
                "coarse": [told.coarse.luma, told.coarse.chroma],
                "boundary": told.boundary,
            })),
            "whole": of.whole,
        })
    };
    let levels: Vec<_> = levels.iter().map(level).collect();
    let axes = &cloud.axes;
    let description = json!({
        "version": header.format.version(),
        "bits": header.bits,
        "points": header.points,
        "levels": levels,
        "total_bytes": bytes.len(),
        "model": header.model(),
        "model_name": known.as_ref().map(|(name, _)| name),
        "heads": known.as_ref().map(|(_, heads)| heads),
        "points_before_merging": cloud.points,
        "up": axes.up.map(|up| up.to_string()),
        "metres_per_unit": axes.metres_per_unit,
        "crs": axes.crs,
        "origin": header.placement.origin,
        "voxel_size": header.placement.voxel_size,
        "notes": notes,
        "complete_to_level": stream.deepest(),
        "top_level": header.top,
        "damage": match state {
            State::Damaged(damage) => Some(damage),
            State::Whole | State::CutAfter(_) => None,
        },
    });
    format!("{description:#}\n")
}

fn text(args: &Info, stream: &Stream, bytes: usize, levels: &[Described], known: Known, state: &State) -> String {
    let header = stream.header();
    let coded = match (header.model(), known, &args.model) {
        (None, ..) => "colours: transform coefficients, no model needed".into(),
        (Some(id), Some((name, heads)), _) => {
            format!("colours: learned, model {id}: {name}, heads: {}", heads.join(", "))
        }
        (Some(id), None, None) => format!("colours: learned, model {id}, which is not the program's own"),
        (Some(id), None, Some(path)) => format!("colours: learned, model {id}, which is not {}", path.display()),
    };
    let placement = header.placement;
    let [x, y, z] = placement.origin;
    let mut text = format!(
        "version {}, {} at {}, {}, {:.4} bits per point\n{coded}\n\
         grid: voxels of {}, {} along each side, from {x} {y} {z}\n\n{}\n",
        header.format.version(),
        counted(header.points, "point"),
        counted(header.bits.into(), "bit"),
        counted(bytes as u64, "byte"),
        bits(bytes as u64, header.points),
        placement.voxel_size,
        count(1 << header.bits),
        table(&rows(levels, header.points)),
    );
    match state {
        State::Whole => {}
        State::CutAfter(level) => text += &format!("cut: complete to level {level} of {}\n", header.top),
        State::Damaged(damage) => text += &format!("damage: {damage}\n"),
    }
    text
}

/// Bits for each point.
fn bits(bytes: u64, points: u64) -> f64 {
    bytes as f64 * 8.0 / points.max(1) as f64
}

/// The table's rows, titles first.
fn rows(levels: &[Described], points: u64) -> Vec<Vec<String>> {
    let titles = [
        "level",
        "voxels",
        "geometry bytes",
        "colour bytes",
        "geometry bpp",
        "colour bpp",
        "step",
        "residual bytes",
        "its steps",
        "bpp up to here",
    ];
    let mut rows = vec![titles.map(String::from).to_vec()];
    for of in levels {
        let missing = if of.whole { "" } else { " (not complete)" };
        rows.push(vec![
            format!("{}{missing}", of.level),
            count(of.voxels.into()),
            count(of.section.geometry.into()),
            count(of.section.colours.into()),
            format!("{:.4}", bits(of.section.geometry.into(), points)),
            format!("{:.4}", bits(of.section.colours.into(), points)),
            of.steps.map_or("-".into(), step_text),
            of.residual.map_or("?".into(), |bytes| count(bytes as u64)),
            of.precision.map_or("-".into(), told),
            format!("{:.4}", bits(of.prefix, points)),
        ]);
    }
    rows
}

/// A step of luma in 255ths.
fn step_text(steps: colour::Steps) -> String {
    match steps.is_lossless() {
        true => "exact".into(),
        false => format!("{:.2}", steps.luma_step()),
    }
}

/// The bands of a residual with their steps of luma and chroma.
fn told(precision: ResidualSteps) -> String {
    let bands = [("fine", precision.fine), ("coarse", precision.coarse)];
    let bands = bands.iter().filter(|(_, steps)| *steps != Steps::NONE);
    let told = bands.map(|(band, steps)| format!("{band} {},{}", steps.luma, steps.chroma));
    told.collect::<Vec<_>>().join(" ")
}
