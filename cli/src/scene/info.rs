//! `b2p info` and `b2p check` of a scene.

use std::path::Path;

use b2p::geometry::morton;
use b2p::{Decoder, Limits, SceneReader};
use serde_json::json;

use super::super::check::{named_clause, refused};
use super::super::manners::{self, Said};
use super::super::table::{count, counted, table};
use super::super::{Failure, Result};

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

/// Checks every block, and says which are not valid.
pub fn check(path: &Path, limits: &Limits) -> Result<String> {
    let scene = SceneReader::new(super::source(path, limits)?, limits).map_err(refused(path))?;
    let checks = scene.check(&Decoder::new().with_limits(limits.clone()));
    let mut faults = Vec::new();
    for (block, checked) in checks.blocks.iter().enumerate() {
        match checked {
            Err(error) => faults.push(format!("{error}{}", named_clause(error))),
            Ok(checked) => {
                let own = checked.faults.iter().map(|fault| &fault.error);
                for error in own.chain(&checked.unchecked) {
                    faults.push(format!("block {block}: {error}{}", named_clause(error)));
                }
            }
        }
    }
    let end = checks.end.iter();
    faults.extend(end.map(|error| format!("{error}{}", named_clause(error))));
    let name = path.display();
    if faults.is_empty() {
        return Ok(format!(
            "{name}: valid, {}\n",
            counted(scene.blocks().len() as u64, "block")
        ));
    }
    let number = counted(faults.len() as u64, "fault");
    Err(Failure(format!("{name}: {number}\n  {}", faults.join("\n  "))))
}
