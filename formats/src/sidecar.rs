//! The file beside a file: what its format has no place for. `cloud.pcd.json` belongs to `cloud.pcd`.

use std::path::{Path, PathBuf};

use b2p::cloud::{Coordinates, Hints, PointCloud, ReadOptions};
use b2p::{Axes, Limits, Placement, Up, input};
use serde_json::{Value, json};

/// The field that tells our files from those of other programs, and its value.
const MARK: &str = "b2p_sidecar";
const VERSION: u64 = 1;
/// Bytes of a file at most: a coordinate system in JSON, every character of it escaped, and the rest.
const MOST: u64 = 6 * Axes::MAX_CRS as u64 + 4096;

/// What stands beside a file.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Sidecar {
    /// What must be added to the coordinates in the file.
    pub offset: [f64; 3],
    /// Up axis, unit and coordinate system.
    pub axes: Axes,
    /// The axis that pointed up before a file of Gaussians was turned to the axes of its format.
    pub turned_from: Option<Up>,
    /// Depth of the voxel grid.
    pub bits: Option<u8>,
    /// The voxel grid in the world.
    pub grid: Option<Placement>,
}

impl Sidecar {
    /// The path of the file beside `path`.
    pub fn path_of(path: &Path) -> PathBuf {
        let mut name = path.as_os_str().to_owned();
        name.push(".json");
        name.into()
    }

    /// What stands beside `path`. `None` if there is no such file, or one of another program.
    pub fn beside(path: &Path) -> Option<Self> {
        let beside = Sidecar::path_of(path);
        let is_file = std::fs::metadata(&beside).is_ok_and(|data| data.is_file());
        let limits = Limits::default().with_max_bytes(MOST);
        let text = is_file.then(|| input::read_file(&beside, &limits).ok()).flatten()?;
        Sidecar::parse(&text)
    }

    /// Reads what [`Sidecar::to_json`] wrote. `None` if it is anything else, or a field has a value that it cannot
    /// have.
    pub fn parse(text: &[u8]) -> Option<Self> {
        let value: Value = serde_json::from_slice(text).ok()?;
        if value[MARK].as_u64() != Some(VERSION) {
            return None;
        }
        let up = |name: &str| match &value[name] {
            Value::Null => Some(None),
            found => found.as_str()?.parse().ok().map(Some),
        };
        let crs = value["crs"].as_str().unwrap_or_default();
        let bits = value["bits"].as_u64().filter(|bits| (1..=21).contains(bits));
        let grid = || {
            let placement = Placement {
                origin: three(&value["origin"])?,
                voxel_size: value["voxel_size"].as_f64()?,
            };
            placement.is_valid().then_some(placement)
        };
        let metres = value["metres_per_unit"].as_f64();
        let known = Sidecar {
            offset: match &value["offset"] {
                Value::Null => [0.0; 3],
                found => three(found)?,
            },
            axes: Axes {
                up: up("up")?,
                metres_per_unit: metres.filter(|m| m.is_finite() && *m > 0.0),
                crs: crs.to_owned(),
            },
            turned_from: up("turned_from")?,
            bits: bits.map(|bits| bits as u8),
            grid: grid(),
        };
        (crs.len() <= Axes::MAX_CRS).then_some(known)
    }

    /// The text of the file beside `path`.
    pub fn to_json(&self, path: &Path) -> String {
        let mut object = json!({ MARK: VERSION });
        let mut put = |name: &str, value: Value| object[name] = value;
        if let Some(name) = path.file_name() {
            put("file", name.to_string_lossy().into());
        }
        if self.offset != [0.0; 3] {
            put("offset", json!(self.offset));
        }
        let axes = &self.axes;
        for (name, up) in [("up", axes.up), ("turned_from", self.turned_from)] {
            if let Some(up) = up {
                put(name, up.to_string().into());
            }
        }
        if let Some(metres) = axes.metres_per_unit {
            put("metres_per_unit", metres.into());
        }
        if !axes.crs.is_empty() {
            put("crs", axes.crs.clone().into());
        }
        if let Some(bits) = self.bits {
            put("bits", bits.into());
        }
        if let Some(grid) = self.grid {
            put("origin", json!(grid.origin));
            put("voxel_size", grid.voxel_size.into());
        }
        format!("{object:#}\n")
    }

    /// The options with what this file says, where they leave it open.
    pub fn options(&self, options: &ReadOptions) -> ReadOptions {
        ReadOptions {
            offset: self.offset,
            up: options.up.or(self.axes.up),
            metres_per_unit: options.metres_per_unit.or(self.axes.metres_per_unit),
            ..options.clone()
        }
    }

    /// Gives a cloud that was read with [`Sidecar::options`] the coordinate system and the grid, unless it has its own.
    pub fn complete(&self, cloud: &mut PointCloud) {
        if cloud.axes.crs.is_empty() {
            cloud.axes.crs.clone_from(&self.axes.crs);
        }
        if cloud.hints == Hints::default() && self.grid.is_some() {
            cloud.hints = Hints {
                bits: self.bits,
                placement: self.grid,
                coordinates: Coordinates::World,
            };
        }
    }

    /// What it says, in words.
    pub fn contents(&self) -> String {
        let parts = [
            ("offset", self.offset != [0.0; 3]),
            ("up axis", self.axes.up.is_some() || self.turned_from.is_some()),
            ("unit", self.axes.metres_per_unit.is_some()),
            ("coordinate system", !self.axes.crs.is_empty()),
            ("grid", self.grid.is_some()),
        ];
        let there = parts.iter().filter(|(_, there)| *there).map(|(name, _)| *name);
        there.collect::<Vec<_>>().join(", ")
    }
}

/// Three finite numbers.
fn three(value: &Value) -> Option<[f64; 3]> {
    let [x, y, z] = value.as_array()?.as_slice() else {
        return None;
    };
    let numbers = [x.as_f64()?, y.as_f64()?, z.as_f64()?];
    numbers.iter().all(|x| x.is_finite()).then_some(numbers)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all() -> Sidecar {
        Sidecar {
            offset: [500_000.0, 0.25, -7.0],
            axes: Axes {
                up: Some(Up::Z),
                metres_per_unit: Some(0.3048),
                crs: "PROJCS[\"Zürich\"]".into(),
            },
            turned_from: Some(Up::MinusX),
            bits: Some(11),
            grid: Some(Placement {
                origin: [1.0, 2.0, 0.1],
                voxel_size: 0.003,
            }),
        }
    }

    #[test]
    fn what_is_written_is_read_again() {
        for sidecar in [all(), Sidecar::default()] {
            let text = sidecar.to_json(Path::new("a/b.pcd"));
            assert_eq!(Sidecar::parse(text.as_bytes()), Some(sidecar));
            assert!(text.contains("\"file\": \"b.pcd\""), "{text}");
        }
        assert_eq!(Sidecar::path_of(Path::new("a/b.pcd")), Path::new("a/b.pcd.json"));
    }

    #[test]
    fn files_of_other_programs_and_impossible_values_are_ignored() {
        let text = all().to_json(Path::new("b.pcd"));
        let with = |name: &str, value: Value| {
            let mut object: Value = serde_json::from_str(&text).unwrap();
            object[name] = value;
            Sidecar::parse(object.to_string().as_bytes())
        };
        assert!(with("more", 1.into()).is_some());
        assert_eq!(with(MARK, 2.into()), None);
        assert_eq!(with("offset", json!([1, 2])), None);
        assert_eq!(with("up", "north".into()), None);
        assert_eq!(with("crs", "x".repeat(Axes::MAX_CRS + 1).into()), None);
        assert_eq!(with("bits", 22.into()).unwrap().bits, None);
        assert_eq!(with("voxel_size", (-1).into()).unwrap().grid, None);
        for text in [&b"{}"[..], b"[]", b"", b"{\"offset\":[1,2,3]}", b"\xff"] {
            assert_eq!(Sidecar::parse(text), None);
        }
    }
}
