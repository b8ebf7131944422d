//! What was measured, for people and for programs.

use serde::{Serialize, Serializer};

use super::effects::EffectCost;
use super::hard_cases::HardCase;
use super::run::Truth;
use super::setting::{Knob, Setting, pareto_front};
use super::{MeasuredInput, Options, TruthKind};
use b2p::Result;
use b2p::container::Header;
use b2p::gaussians::HeadSet;
use b2p::metrics::Distance;
use b2p::metrics::Machine;
use b2p::metrics::{Spread, Verdict};
use b2p::renderer::Image;

/// The stages, four of decoding and four of drawing. Geometry includes kernel maps, but of a stream of version 3 not
/// what is decoded beside the colours of the level above. Reconstruction is the colour filter, or the features of
/// version 2.
pub const STAGES: [&str; 8] = [
    "geometry",
    "colours",
    "reconstruction",
    "heads",
    "project",
    "bin",
    "sort",
    "blend",
];

/// What a setting took, in milliseconds, and how near its pictures came.
#[derive(Debug, Clone)]
pub struct Measured {
    /// Each of [`STAGES`].
    pub stages: [Spread; STAGES.len()],
    /// From bytes to Gaussians.
    pub decode: Spread,
    /// From Gaussians to one picture, the mean of all views.
    pub picture: Spread,
    /// Both.
    pub total: Spread,
    /// From the most accurate computation: the means of all views, and the worst pixel of all.
    pub distance: Distance,
    /// From the truth, where it is at hand.
    pub from_truth: Option<FromTruth>,
    /// The view that has the worst pixel.
    pub view: usize,
    /// Bytes of memory that decoding takes at most: [`b2p::Decoder::memory`].
    pub memory: u64,
    /// The surroundings of the worst pixel.
    pub crop: Option<Crop>,
}

/// How near pictures come to the truth.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct FromTruth {
    /// PSNR in dB.
    pub psnr: f64,
    /// SSIMULACRA2; `None` of pictures too small for it.
    pub ssimulacra2: Option<f64>,
}

/// The surroundings of a pixel.
#[derive(Debug, Clone)]
pub struct Crop {
    /// As they should be.
    pub truth: Image,
    /// As they are.
    pub picture: Image,
}

impl Crop {
    /// The pixels up to `reach` away from the one at `at`, as far as there are any.
    pub fn around(truth: &Image, picture: &Image, at: [u32; 2], reach: u32) -> Crop {
        let cut = |image: &Image| {
            let range = |at: u32, side: u32| at.saturating_sub(reach)..(at + reach).min(side);
            let (columns, rows) = (range(at[0], image.width), range(at[1], image.height));
            Image {
                width: columns.len() as u32,
                height: rows.len() as u32,
                pixels: rows
                    .flat_map(|y| columns.clone().map(move |x| (x, y)))
                    .map(|(x, y)| image.pixel(x, y))
                    .collect(),
            }
        };
        Crop {
            truth: cut(truth),
            picture: cut(picture),
        }
    }

    /// Grey where they are equal, differences `gain` times as large.
    pub fn difference(&self, gain: f32) -> Image {
        let apart = |(a, b): (&[f32; 4], &[f32; 4])| {
            let value = |k: usize| 0.5 + gain * (b[k].clamp(0.0, 1.0) - a[k].clamp(0.0, 1.0));
            [value(0), value(1), value(2), 1.0]
        };
        let pairs = self.truth.pixels.iter().zip(&self.picture.pixels);
        Image {
            pixels: pairs.map(apart).collect(),
            ..self.truth
        }
    }
}

/// One setting's figures.
#[derive(Debug, Clone, Serialize)]
pub struct Row {
    /// What differs from the default.
    pub knob: Knob,
    /// Octree level.
    pub level: u8,
    /// What generated the Gaussians.
    pub heads: String,
    /// Precision of the network.
    pub precision: String,
    /// Instructions.
    pub isa: String,
    /// Threads.
    pub threads: usize,
    /// Quality of the renderer.
    pub quality: String,
    /// Width and height of the pictures drawn.
    pub size: [u32; 2],
    /// Milliseconds by stage.
    #[serde(serialize_with = "by_stage")]
    pub stages: [Spread; STAGES.len()],
    /// Milliseconds from bytes to Gaussians.
    pub decode: Spread,
    /// Milliseconds from Gaussians to a picture.
    pub picture: Spread,
    /// Milliseconds of both.
    pub total: Spread,
    /// [`Row::decode`] against the default's.
    pub decode_verdict: Verdict,
    /// [`Row::picture`] against the default's.
    pub picture_verdict: Verdict,
    /// In dB against the most accurate computation; `None` (in JSON, null) for equal pictures.
    pub psnr: Option<f64>,
    /// Multi-scale structural similarity to it; `None` of pictures too small for it.
    pub ms_ssim: Option<f64>,
    /// Against the truth, where that was at hand.
    pub truth: Option<FromTruth>,
    /// The largest difference of a channel from the most accurate computation in steps of eight bits.
    pub worst: f64,
    /// View, column and row where it is.
    pub worst_at: [u32; 3],
    /// Bytes of memory that decoding takes at most, an upper bound from the stream's header.
    pub most_memory: u64,
    /// Whether no combination decodes and draws a picture as well ([`Row::accuracy`]) in less time.
    pub on_front: bool,
    /// The same of the picture alone, once there are Gaussians.
    pub on_picture_front: bool,
    /// The surroundings of the worst pixel.
    #[serde(skip)]
    pub crop: Option<Crop>,
}

fn by_stage<S: Serializer>(stages: &[Spread; STAGES.len()], to: S) -> std::result::Result<S::Ok, S::Error> {
    to.collect_map(STAGES.iter().zip(stages))
}

impl Row {
    pub(super) fn new(knob: Knob, setting: Setting, measured: Measured, options: &Options) -> Row {
        let Measured {
            stages,
            decode,
            picture,
            total,
            distance,
            from_truth,
            view,
            memory,
            crop,
        } = measured;
        let [x, y] = distance.at;
        Row {
            knob,
            level: setting.decode.level,
            heads: setting.decode.heads.to_string(),
            precision: setting.decode.precision.to_string(),
            isa: setting.decode.isa.to_string(),
            threads: setting.decode.threads,
            quality: setting.quality.to_string(),
            size: options.size.map(|side| side.div_ceil(setting.shrink)),
            stages,
            decode,
            picture,
            total,
            decode_verdict: Verdict::Same,
            picture_verdict: Verdict::Same,
            psnr: Some(distance.psnr()).filter(|psnr| psnr.is_finite()),
            ms_ssim: distance.ms_ssim,
            truth: from_truth,
            worst: distance.worst,
            worst_at: [view as u32, x, y],
            most_memory: memory,
            on_front: false,
            on_picture_front: false,
            crop,
        }
    }

    /// What its knob is turned to; of a combination, all of them.
    pub fn name(&self) -> String {
        let size = format!("{}×{}", self.size[0], self.size[1]);
        match self.knob {
            Knob::Level => format!("level {}", self.level),
            Knob::Heads => format!("{} heads", self.heads),
            Knob::Precision => self.precision.clone(),
            Knob::Quality => self.quality.clone(),
            Knob::Size => size,
            Knob::Isa => self.isa.clone(),
            Knob::Threads if self.threads == 1 => "1 thread".into(),
            Knob::Threads => format!("{} threads", self.threads),
            Knob::Default | Knob::Combination => {
                let Row {
                    level,
                    precision,
                    quality,
                    ..
                } = self;
                let heads = match self.heads == HeadSet::Best.to_string() {
                    true => String::new(),
                    false => format!("{} heads, ", self.heads),
                };
                format!("level {level}, {heads}{precision}, {quality}, {size}")
            }
        }
    }

    /// [`Row::psnr`] as a number: infinite for equal pictures.
    pub fn decibel(&self) -> f64 {
        self.psnr.unwrap_or(f64::INFINITY)
    }
}

impl Row {
    /// What fronts are drawn by, in tenths of a dB: PSNR against the truth, or, without one, against the computation.
    pub fn accuracy(&self) -> f64 {
        let psnr = self.truth.map_or(self.decibel(), |truth| truth.psnr);
        (psnr * 10.0).round() / 10.0
    }
}

/// A level of the stream.
#[derive(Debug, Clone, Serialize)]
pub struct LevelSize {
    /// Octree level.
    pub level: u8,
    /// Occupied voxels.
    pub voxels: u32,
    /// Bytes of the stream up to its end.
    pub bytes: u64,
}

/// All that was measured.
#[derive(Debug, Clone, Serialize)]
pub struct Report {
    /// On what.
    pub machine: Machine,
    /// Of what.
    pub levels: Vec<LevelSize>,
    /// Width and height of the pictures.
    pub size: [u32; 2],
    /// Pictures.
    pub views: u32,
    /// Times.
    pub repeats: u32,
    /// What the truth is, where it was at hand.
    pub truth: Option<TruthKind>,
    /// Milliseconds that generating Gaussians in double precision took, and drawing one picture of them; once each.
    pub double_ms: [f64; 2],
    /// The default, then one knob at a time.
    pub ladder: Vec<Row>,
    /// Levels, heads, precisions, qualities and sizes: see [`super::Choices::combinations`].
    pub combinations: Vec<Row>,
    /// Hard cases of the renderer, with every quality, and with the default one on the other instruction sets.
    pub renderer_cases: Vec<HardCase>,
    /// Hard cases of the network's generators, in every precision.
    pub network_cases: Vec<HardCase>,
    /// What effects cost.
    pub effects: Vec<EffectCost>,
}

impl Report {
    pub(super) fn new(
        subject: &MeasuredInput<'_>,
        options: &Options,
        truth: &Truth,
        mut ladder: Vec<Row>,
        mut combinations: Vec<Row>,
    ) -> Result<Report> {
        let default = ladder.first().map(|row| [row.decode, row.picture]);
        if let Some([decode, picture]) = default {
            for row in ladder.iter_mut().chain(&mut combinations) {
                row.decode_verdict = row.decode.against(&decode);
                row.picture_verdict = row.picture.against(&picture);
            }
        }
        let points = |time: fn(&Row) -> f64| -> Vec<(f64, f64)> {
            let point = |row: &Row| (time(row), row.accuracy());
            combinations.iter().map(point).collect()
        };
        let front = pareto_front(&points(|row| row.total.median));
        let picture_front = pareto_front(&points(|row| row.picture.median));
        for (row, (on, on_picture)) in combinations.iter_mut().zip(front.into_iter().zip(picture_front)) {
            (row.on_front, row.on_picture_front) = (on, on_picture);
        }
        let header = Header::parse(subject.stream, subject.limits)?;
        let levels = (header.base..=header.top).zip(&header.voxels);
        let levels = levels.map(|(level, &voxels)| {
            Ok(LevelSize {
                level,
                voxels,
                bytes: header.prefix_bytes(level)?,
            })
        });
        Ok(Report {
            machine: Machine::this(),
            levels: levels.collect::<Result<_>>()?,
            size: options.size,
            views: options.views,
            repeats: options.repeats,
            truth: subject.truth_kind(),
            double_ms: [truth.generate, truth.draw],
            ladder,
            combinations,
            renderer_cases: Vec::new(),
            network_cases: Vec::new(),
            effects: Vec::new(),
        })
    }
}
