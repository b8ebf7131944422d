//! `b2p info` and `b2p check` of a scene.

use std::path::Path;

use b2p::geometry::morton;
use b2p::{Decoder, Error, Limits, SceneReader};
use serde_json::json;

use super::super::Result;
use super::super::check::{UnitFault, Units, chunk_text, refused};
use super::super::manners::{self, Said};
use super::super::table::{count, counted, table};

/// Blocks that are listed, unless all are asked for.
const LISTED: usize = 20;

/// Says what a scene holds.
pub fn run(path: &Path, limits: &Limits) -> Result<Said> {
    let scene = super::open(path, limits)?;
    let header = scene.header();
    let per_point = scene.bytes() as f64 * 8.0 / header.points.max(1) as f64;
    let axes = scene.axes().unwrap_or_default();
    if manners::json() {
        let block = |block: &b2p::container::scene::BlockEntry| {
            json!({
                "level": block.cube.level,
                "at": morton::decode(block.cube.key),
                "points": block.points,
                "voxels": block.voxels,
                "offset": block.offset,
                "bytes": block.bytes,
            })
        };
        let value = json!({
            "bits": header.bits,
            "levels": [header.base, header.top],
            "points": header.points,
            "voxels": header.voxels,
            "origin": header.placement.origin,
            "voxel_size": header.placement.voxel_size,
            "bytes": scene.bytes(),
            "bits_per_point": per_point,
            "blocks": scene.blocks().iter().map(block).collect::<Vec<_>>(),
        });
        return Ok(Said::result(format!("{value:#}\n")));
    }
    let mut text = format!(
        "scene of {}, {} at {}, {per_point:.4} bits per point\n",
        counted(scene.blocks().len() as u64, "block"),
        counted(header.points, "point"),
        counted(header.bits.into(), "bit"),
    );
    for (level, voxels) in (header.base..).zip(&header.voxels) {
        text += &format!("level {level}: {}\n", counted((*voxels).into(), "voxel"));
    }
    text += &super::super::cloud::described(&axes);
    let mut rows = vec![
        ["block", "level", "at", "points", "bytes", "bits per point"]
            .map(String::from)
            .to_vec(),
    ];
    let listed = if manners::verbose() { usize::MAX } else { LISTED };
    for (number, block) in scene.blocks().iter().enumerate().take(listed) {
        let [x, y, z] = morton::decode(block.cube.key);
        rows.push(vec![
            number.to_string(),
            block.cube.level.to_string(),
            format!("{x},{y},{z}"),
            count(block.points.into()),
            count(block.bytes.into()),
            format!("{:.4}", f64::from(block.bytes) * 8.0 / f64::from(block.points.max(1))),
        ]);
    }
    text += &table(&rows);
    if let Some(more) = scene.blocks().len().checked_sub(listed).filter(|more| *more > 0) {
        text += &format!("and {more} more (-v lists them)\n");
    }
    Ok(Said::result(text))
}

/// Checks every block, and says what is wrong, and where.
pub fn check(path: &Path, limits: &Limits) -> Result<Units> {
    let scene = SceneReader::new(super::source(path, limits)?, limits).map_err(refused(path))?;
    let checks = scene.check(&Decoder::new().with_limits(limits.clone()));
    let mut faults = Vec::new();
    for (block, checked) in (0u64..).zip(&checks.blocks) {
        let unit = Some(("block", block));
        match checked {
            Err(error) => faults.push(UnitFault {
                unit,
                what: match error {
                    Error::Block { source, .. } => source.to_string(),
                    error => error.to_string(),
                },
                ..UnitFault::of_file(error)
            }),
            Ok(checked) => {
                faults.extend(checked.faults.iter().map(|fault| UnitFault {
                    unit,
                    level: fault.level,
                    part: checked.chunk_of(fault).map(chunk_text),
                    ..UnitFault::of_file(&fault.error)
                }));
                faults.extend(checked.unchecked.iter().map(|error| UnitFault {
                    unit,
                    ..UnitFault::of_file(error)
                }));
            }
        }
    }
    faults.extend(checks.end.iter().map(UnitFault::of_file));
    Ok(Units {
        count: counted(scene.blocks().len() as u64, "block"),
        faults,
    })
}
