//! How a cloud's coordinates are to be understood: which way is up, how long a unit is, in which coordinate system.

use crate::error::Error;

/// The axis that points up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[allow(missing_docs)]
pub enum Up {
    X,
    MinusX,
    Y,
    MinusY,
    Z,
    MinusZ,
}

/// What is known of a cloud's coordinates beside their values. The default: nothing.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Axes {
    /// The axis that points up.
    pub up: Option<Up>,
    /// Length of a unit in metres. Finite and above 0.
    pub metres_per_unit: Option<f64>,
    /// The coordinate system as its source has it, such as WKT or `EPSG:32633`; empty if there is none. At most
    /// [`Axes::MAX_CRS`] bytes.
    pub crs: String,
}

/// Names of units, with their lengths in metres.
const UNITS: [(&str, f64); 7] = [
    ("m", 1.0),
    ("mm", 0.001),
    ("cm", 0.01),
    ("km", 1000.0),
    ("in", 0.0254),
    ("ft", 0.3048),
    ("us-ft", 1200.0 / 3937.0),
];

const NAMES: [(&str, Up); 6] = [
    ("x", Up::X),
    ("-x", Up::MinusX),
    ("y", Up::Y),
    ("-y", Up::MinusY),
    ("z", Up::Z),
    ("-z", Up::MinusZ),
];

impl Up {
    /// The axis (0 to 2) and whether its negative direction is up.
    pub fn axis(self) -> (usize, bool) {
        let code = usize::from(self.code() - 1);
        (code / 2, code % 2 == 1)
    }

    /// The rotation, row by row, after which +y is up. What was +x stays +x unless it was up or down.
    pub fn to_y(self) -> [[f64; 3]; 3] {
        match self {
            Up::Y => [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            Up::MinusY => [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]],
            Up::Z => [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]],
            Up::MinusZ => [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]],
            Up::X => [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
            Up::MinusX => [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
        }
    }

    /// 1 to 6: +x, −x, +y, −y, +z, −z.
    fn code(self) -> u8 {
        match self {
            Up::X => 1,
            Up::MinusX => 2,
            Up::Y => 3,
            Up::MinusY => 4,
            Up::Z => 5,
            Up::MinusZ => 6,
        }
    }
}

impl std::str::FromStr for Up {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self, Error> {
        let bare = name.trim_start_matches('+').to_ascii_lowercase();
        let found = NAMES.iter().find(|(known, _)| *known == bare);
        let names = "x, y, z, -x, -y or -z";
        found
            .map(|(_, up)| *up)
            .ok_or_else(|| Error::Usage(format!("{name:?} is no axis, expected {names}")))
    }
}

impl std::fmt::Display for Up {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let name = NAMES.iter().find(|(_, up)| up == self);
        f.write_str(name.map_or("", |(name, _)| name))
    }
}

impl Axes {
    /// Maximum length of [`Axes::crs`] in bytes.
    pub const MAX_CRS: usize = 1 << 16;

    /// Whether nothing is known.
    pub fn is_empty(&self) -> bool {
        *self == Axes::default()
    }

    /// The length in metres of a unit: `m`, `cm`, `mm`, `km`, `in`, `ft`, `us-ft`, or a number of metres.
    ///
    /// # Errors
    /// [`Error::Usage`] if it is none of them.
    pub fn parse_unit(name: &str) -> Result<f64, Error> {
        if let Some((_, metres)) = UNITS.iter().find(|(known, _)| *known == name) {
            return Ok(*metres);
        }
        match name.parse() {
            Ok(metres) if f64::is_finite(metres) && metres > 0.0 => Ok(metres),
            _ => {
                let expected = "m, cm, mm, km, in, ft, us-ft, or the metres of a unit such as 0.5";
                Err(Error::Usage(format!(
                    "{name:?} is no unit of length, expected {expected}"
                )))
            }
        }
    }

    /// The unit by its name, else in metres. `None` if it is not known.
    pub fn unit_name(&self) -> Option<String> {
        let metres = self.metres_per_unit?;
        let known = UNITS.iter().find(|(_, length)| *length == metres);
        Some(known.map_or_else(|| format!("{metres} m"), |(name, _)| (*name).to_owned()))
    }

    /// The bytes of the chunk `format.md` 3.4 for them. A longer coordinate system than allowed is left out.
    pub(crate) fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = vec![self.up.map_or(0, Up::code)];
        bytes.extend(self.metres_per_unit.unwrap_or(0.0).to_le_bytes());
        if self.crs.len() <= Self::MAX_CRS {
            bytes.extend(self.crs.as_bytes());
        }
        bytes
    }

    /// Reads what [`Axes::to_bytes`] wrote. `None` if it is anything else: the chunk is ignored then.
    pub(crate) fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let (&code, rest) = bytes.split_first()?;
        let (unit, crs) = rest.split_first_chunk()?;
        if code > 6 || crs.len() > Self::MAX_CRS {
            return None;
        }
        let unit = f64::from_le_bytes(*unit);
        let metres_per_unit = match unit {
            0.0 => None,
            _ if unit.is_finite() && unit > 0.0 => Some(unit),
            _ => return None,
        };
        Some(Axes {
            up: NAMES.iter().map(|(_, up)| *up).find(|up| up.code() == code),
            metres_per_unit,
            crs: std::str::from_utf8(crs).ok()?.to_owned(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_come_back_from_their_bytes() {
        for (name, up) in NAMES {
            assert_eq!(name.parse::<Up>().unwrap(), up);
            assert_eq!(up.to_string(), name);
            for metres_per_unit in [None, Some(0.3048)] {
                let axes = Axes {
                    up: Some(up),
                    metres_per_unit,
                    crs: "EPSG:32633 Zürich".into(),
                };
                assert_eq!(Axes::from_bytes(&axes.to_bytes()), Some(axes));
            }
        }
        assert_eq!(Axes::from_bytes(&Axes::default().to_bytes()), Some(Axes::default()));
    }

    #[test]
    fn bytes_that_are_no_axes_are_ignored() {
        let whole = Axes::default().to_bytes();
        for length in 0..whole.len() {
            assert_eq!(Axes::from_bytes(&whole[..length]), None);
        }
        let with = |at: usize, bytes: &[u8]| {
            let mut all = whole.clone();
            all.resize(all.len().max(at + bytes.len()), 0);
            all[at..at + bytes.len()].copy_from_slice(bytes);
            Axes::from_bytes(&all)
        };
        assert_eq!(with(0, &[7]), None);
        for unit in [f64::NAN, f64::INFINITY, -1.0] {
            assert_eq!(with(1, &unit.to_le_bytes()), None);
        }
        assert_eq!(with(9, &[0xff]), None);
        assert_eq!(with(9, &vec![b'a'; Axes::MAX_CRS + 1]), None);
        assert!(with(9, &vec![b'a'; Axes::MAX_CRS]).is_some());
    }

    #[test]
    fn each_rotation_turns_its_axis_up_and_mirrors_nothing() {
        for (_, up) in NAMES {
            let (axis, negative) = up.axis();
            let rows = up.to_y();
            let column = [rows[0][axis], rows[1][axis], rows[2][axis]];
            assert_eq!(column, [0.0, if negative { -1.0 } else { 1.0 }, 0.0], "{up}");
            let [a, b, c] = rows;
            let cross = [
                b[1] * c[2] - b[2] * c[1],
                b[2] * c[0] - b[0] * c[2],
                b[0] * c[1] - b[1] * c[0],
            ];
            assert_eq!((0..3).map(|i| a[i] * cross[i]).sum::<f64>(), 1.0, "{up}");
        }
    }

    #[test]
    fn units_are_names_or_metres() {
        let unit = |name| Axes::parse_unit(name).ok();
        assert_eq!(unit("mm"), Some(0.001));
        assert_eq!(unit("0.5"), Some(0.5));
        assert_eq!(unit("0"), None);
        assert_eq!(unit("parsec"), None);
        let named = |metres| {
            Axes {
                metres_per_unit: metres,
                ..Axes::default()
            }
            .unit_name()
        };
        assert_eq!(named(Some(0.01)).as_deref(), Some("cm"));
        assert_eq!(named(Some(0.5)).as_deref(), Some("0.5 m"));
        assert_eq!(named(None), None);
    }
}
