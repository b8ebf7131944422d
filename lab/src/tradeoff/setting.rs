//! The knobs, and the settings that are tried.

use b2p::Isa;
use serde::Serialize;

use b2p::gaussians::HeadSet;
use b2p::layers::Precision;
use b2p::renderer::Quality;

/// One way from a stream to pictures.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Setting {
    /// How it is decoded.
    pub decode: Decode,
    /// How much of what is faint is left out of the pictures.
    pub quality: Quality,
    /// How much smaller than the reference the pictures are drawn, along each side; they are enlarged to be compared.
    pub shrink: u32,
}

/// One way from a stream to Gaussians. Instructions and threads are those of drawing, too.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Decode {
    /// The octree level.
    pub level: u8,
    /// What generates Gaussians.
    pub heads: HeadSet,
    /// What they are generated in.
    pub precision: Precision,
    /// Instructions.
    pub isa: Isa,
    /// Threads.
    pub threads: usize,
}

/// What one setting has other than the default.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Knob {
    /// Nothing.
    Default,
    /// [`Decode::level`].
    Level,
    /// [`Decode::heads`].
    Heads,
    /// [`Decode::precision`].
    Precision,
    /// [`Setting::quality`].
    Quality,
    /// [`Setting::shrink`].
    Size,
    /// [`Decode::isa`].
    Isa,
    /// [`Decode::threads`].
    Threads,
    /// Several of them.
    Combination,
}

impl Knob {
    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Knob::Default => "default",
            Knob::Level => "level",
            Knob::Heads => "heads",
            Knob::Precision => "precision",
            Knob::Quality => "quality",
            Knob::Size => "size",
            Knob::Isa => "isa",
            Knob::Threads => "threads",
            Knob::Combination => "combination",
        }
    }
}

/// Qualities to try: those with names, and floors of α below, between and above.
pub const QUALITIES: [Quality; 5] = [
    Quality::Floor(1.0 / 64.0),
    Quality::Fast,
    Quality::Floor(1.0 / 1024.0),
    Quality::Fine,
    Quality::Exact,
];

/// Qualities to combine with other knobs.
const COMBINED: [Quality; 2] = [Quality::Fast, Quality::Fine];

/// Sizes to try, the reference's first.
const SHRINKS: [u32; 3] = [1, 2, 4];

/// What there is to choose from.
pub struct Choices {
    /// Levels with Gaussians, the finest last.
    pub levels: Vec<u8>,
    /// Heads that there are, the default first.
    pub heads: Vec<HeadSet>,
    /// Precisions that the model has, the default first.
    pub precisions: Vec<Precision>,
    /// Threads that the caller has.
    pub threads: usize,
}

impl Choices {
    /// What the program does when nothing is said; none of a stream without Gaussians.
    pub fn default_setting(&self) -> Option<Setting> {
        Some(Setting {
            decode: Decode {
                level: *self.levels.last()?,
                heads: *self.heads.first()?,
                precision: *self.precisions.first()?,
                isa: Isa::detect(),
                threads: self.threads,
            },
            quality: Quality::default(),
            shrink: 1,
        })
    }

    /// The default, then every other value of every knob by itself.
    pub fn ladder(&self) -> Vec<(Knob, Setting)> {
        let Some(default) = self.default_setting() else {
            return Vec::new();
        };
        let mut ladder = vec![(Knob::Default, default)];
        let mut push = |knob, setting| {
            if setting != default {
                ladder.push((knob, setting));
            }
        };
        let with = |decode| Setting { decode, ..default };
        let decode = default.decode;
        for &level in &self.levels {
            push(Knob::Level, with(Decode { level, ..decode }));
        }
        for &heads in &self.heads {
            push(Knob::Heads, with(Decode { heads, ..decode }));
        }
        for &precision in &self.precisions {
            push(Knob::Precision, with(Decode { precision, ..decode }));
        }
        for quality in QUALITIES {
            push(Knob::Quality, Setting { quality, ..default });
        }
        for shrink in SHRINKS {
            push(Knob::Size, Setting { shrink, ..default });
        }
        for isa in Isa::available() {
            push(Knob::Isa, with(Decode { isa, ..decode }));
        }
        let mut threads = 1;
        while threads < self.threads {
            push(Knob::Threads, with(Decode { threads, ..decode }));
            threads *= 2;
        }
        ladder
    }

    /// All combinations of level, heads, precision, `COMBINED` qualities, and the two larger sizes; those of other
    /// heads than the best in the default precision, as they are for who lacks time.
    pub fn combinations(&self) -> Vec<Setting> {
        let Some(default) = self.default_setting() else {
            return Vec::new();
        };
        let mut all = Vec::new();
        let best = self.precisions.iter().map(|p| (default.decode.heads, *p));
        let others = self.heads.iter().filter(|h| **h != default.decode.heads);
        let generators = best.chain(others.map(|h| (*h, default.decode.precision)));
        let generators: Vec<_> = generators.collect();
        for &level in &self.levels {
            for &(heads, precision) in &generators {
                for quality in COMBINED {
                    all.extend(SHRINKS[..2].iter().map(|&shrink| Setting {
                        decode: Decode {
                            level,
                            heads,
                            precision,
                            ..default.decode
                        },
                        quality,
                        shrink,
                    }));
                }
            }
        }
        all
    }
}

/// The settings that no other beats: none has as much accuracy in as little time, and more of one. Each is a time and
/// an accuracy.
pub fn pareto_front(points: &[(f64, f64)]) -> Vec<bool> {
    let beats = |a: &(f64, f64), b: &(f64, f64)| a.0 <= b.0 && a.1 >= b.1 && a != b;
    points
        .iter()
        .map(|point| !points.iter().any(|other| beats(other, point)))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn choices() -> Choices {
        Choices {
            levels: vec![8, 9],
            heads: HeadSet::ALL.to_vec(),
            precisions: vec![Precision::Int16, Precision::F16],
            threads: 4,
        }
    }

    #[test]
    fn the_ladder_turns_one_knob_at_a_time() {
        let ladder = choices().ladder();
        let default = ladder[0].1;
        assert_eq!((ladder[0].0, default.decode.level), (Knob::Default, 9));
        for (knob, setting) in &ladder[1..] {
            let (a, b) = (setting.decode, default.decode);
            let turned = [
                (Knob::Level, a.level != b.level),
                (Knob::Heads, a.heads != b.heads),
                (Knob::Precision, a.precision != b.precision),
                (Knob::Quality, setting.quality != default.quality),
                (Knob::Size, setting.shrink != default.shrink),
                (Knob::Isa, a.isa != b.isa),
                (Knob::Threads, a.threads != b.threads),
            ];
            for (other, turned) in turned {
                assert_eq!(turned, other == *knob, "{setting:?}");
            }
        }
        let threads = ladder.iter().filter(|(knob, _)| *knob == Knob::Threads);
        assert_eq!(threads.count(), 2);
    }

    #[test]
    fn combinations_are_all_different_and_hold_the_default() {
        let choices = choices();
        let all = choices.combinations();
        assert_eq!(all.len(), 2 * 4 * COMBINED.len() * 2);
        assert!(all.contains(&choices.default_setting().unwrap()));
        for (i, a) in all.iter().enumerate() {
            assert!(!all[..i].contains(a));
        }
    }

    #[test]
    fn without_levels_there_is_nothing_to_try() {
        let none = Choices {
            levels: Vec::new(),
            ..choices()
        };
        assert!(none.ladder().is_empty() && none.combinations().is_empty());
    }

    #[test]
    fn the_front_is_what_nothing_beats() {
        let points = [(1.0, 30.0), (2.0, 40.0), (3.0, 35.0), (2.5, 40.0), (9.0, 50.0)];
        assert_eq!(pareto_front(&points), [true, true, false, false, true]);
        assert_eq!(pareto_front(&[(1.0, 5.0), (1.0, 5.0)]), [true, true]);
    }
}
