//! Measuring: every setting once in every repeat, so that whatever disturbs the machine disturbs all alike.

use std::time::Instant;

use rayon::ThreadPool;

use super::report::{Crop, FromTruth, Measured, STAGES};
use super::setting::{Choices, Decode, Setting};
use super::truth::{in_double, of_origin};
use super::{MeasuredInput, Options};
use crate::eval::metrics::Ssimulacra2;
use crate::eval::picture::Picture;
use b2p::container::Header;
use b2p::gaussians::learned::HeadsModel;
use b2p::gaussians::{Gaussians, HeadSet};
use b2p::latents::network::Model;
use b2p::layers::Precision;
use b2p::log::{Log, Step};
use b2p::metrics::Spread;
use b2p::metrics::{Distance, pixels_apart, psnr, resized};
use b2p::renderer::reference::{self, Cutoffs};
use b2p::renderer::{Background, Image, Renderer};
use b2p::{Decoder, Error, Isa, Result};

/// Half the side of the cut-out around a worst pixel.
const CROP: u32 = 28;

/// Wall time of one run in milliseconds, and of its stages.
#[derive(Clone, Copy, Default)]
struct Lap {
    stages: [f64; 4],
    total: f64,
}

/// One way of decoding, and what it took.
struct Decoding {
    how: Decode,
    laps: Vec<Lap>,
    memory: u64,
}

/// One way of drawing, and what it took; the Gaussians are those of its level, heads and precision.
struct Drawing {
    how: Setting,
    laps: Vec<Lap>,
    distance: Option<Distance>,
    from_truth: Option<FromTruth>,
    view: usize,
    crop: Option<Crop>,
}

/// All that is measured.
pub(super) struct Run<'a> {
    subject: &'a MeasuredInput<'a>,
    options: &'a Options,
    decoders: Vec<(Decode, Decoder)>,
    pools: Vec<(usize, ThreadPool)>,
    decodings: Vec<Decoding>,
    drawings: Vec<Drawing>,
    gaussians: Vec<(Kind, Gaussians)>,
}

/// What Gaussians depend on.
type Kind = (u8, HeadSet, Precision);

fn kind(how: &Decode) -> Kind {
    (how.level, how.heads, how.precision)
}

/// The pictures as they should be, and what they took, in milliseconds.
pub(super) struct Truth {
    pub images: Vec<Image>,
    /// Those of the object, where it is at hand, with what compares others with them if they are large enough.
    pub origin: Option<Vec<TrueView>>,
    pub generate: f64,
    pub draw: f64,
}

/// What a camera sees of the object.
pub(super) struct TrueView {
    image: Image,
    ssimulacra2: Option<Ssimulacra2>,
}

fn milliseconds(since: Instant) -> f64 {
    since.elapsed().as_secs_f64() * 1e3
}

/// The stage, of the first four of [`STAGES`], that a step of decoding belongs to.
fn stage_of(step: &Step) -> usize {
    let first = step.name.split(' ').next().unwrap_or_default();
    match first {
        "geometry" | "kernel" => 0,
        "latents" | "colours" => 1,
        "generate" | "activate" | "Gaussians" => 3,
        _ => 2,
    }
}

/// Whether the model can be had in this precision here. `half` needs arithmetic in f16.
fn has_precision(subject: &MeasuredInput<'_>, precision: Precision) -> Result<bool> {
    Ok(match subject.is_learned() {
        true => Model::from_bytes(subject.model)?.with_precision(precision).is_ok(),
        false => precision != Precision::Half || Isa::detect().has_half(),
    })
}

/// What decodes with this setting.
fn decoder(subject: &MeasuredInput<'_>, how: Decode) -> Result<Decoder> {
    let decoder = match subject.is_learned() {
        true => {
            let model = Model::from_bytes(subject.model)?.with_isa(how.isa);
            subject.decoder()?.with_model(model.with_precision(how.precision)?)
        }
        false => subject.decoder()?.with_precision(how.precision),
    };
    let decoder = decoder.with_isa(how.isa).with_level(how.level);
    Ok(decoder.with_heads(how.heads))
}

/// Means over all views; no SSIMULACRA2 of pictures too small for it.
fn from_truth(views: &[TrueView], images: &[Image]) -> FromTruth {
    let count = images.len() as f64;
    let pairs = || views.iter().zip(images);
    let squares: f64 = pairs().map(|(view, image)| pixels_apart(&view.image, image).0).sum();
    let score = |(view, image): (&TrueView, &Image)| {
        let own = view.ssimulacra2.as_ref()?;
        own.score(&Picture::from(image)).ok()
    };
    let scores: Option<f64> = pairs().map(score).sum();
    FromTruth {
        psnr: psnr(squares / count),
        ssimulacra2: scores.map(|sum| sum / count),
    }
}

impl<'a> Run<'a> {
    /// What decodes and draws with each of the settings, ready to be measured.
    ///
    /// # Errors
    /// Those of [`Header::parse`], of reading the model, and [`crate::Error::Usage`] for a setting that the model does
    /// not have.
    pub fn new(subject: &'a MeasuredInput<'a>, options: &'a Options, settings: &[Setting]) -> Result<Self> {
        let header = Header::parse(subject.stream, subject.limits)?;
        let mut run = Run {
            subject,
            options,
            decoders: Vec::new(),
            pools: Vec::new(),
            decodings: Vec::new(),
            drawings: Vec::new(),
            gaussians: Vec::new(),
        };
        for &how in settings {
            if !run.drawings.iter().any(|d| d.how == how) {
                run.drawings.push(Drawing {
                    how,
                    laps: Vec::new(),
                    distance: None,
                    from_truth: None,
                    view: 0,
                    crop: None,
                });
            }
            let how = how.decode;
            if run.decodings.iter().any(|d| d.how == how) {
                continue;
            }
            let decoder = decoder(subject, how)?;
            let memory = decoder.memory(&header, how.level)?;
            run.decoders.push((how, decoder));
            run.decodings.push(Decoding {
                how,
                laps: Vec::new(),
                memory,
            });
            if !run.pools.iter().any(|(threads, _)| *threads == how.threads) {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(how.threads);
                let pool = pool
                    .build()
                    .map_err(|e| Error::Usage(format!("cannot start {} threads: {e}", how.threads)))?;
                run.pools.push((how.threads, pool));
            }
        }
        Ok(run)
    }

    /// What there is to choose from for a stream.
    ///
    /// # Errors
    /// Those of reading the model, and of [`Decoder::levels`].
    pub fn choices(subject: &MeasuredInput<'_>) -> Result<Choices> {
        let levels = subject.decoder()?.levels(subject.stream)?;
        let heads: Vec<HeadSet> = match subject.is_learned() {
            true => Model::from_bytes(subject.model)?
                .shape()
                .heads()
                .into_iter()
                .map(HeadSet::from)
                .collect(),
            false => {
                let model = HeadsModel::from_bytes(subject.model)?;
                let has = |set: &HeadSet| {
                    set.learned()
                        .is_none_or(|own| model.sets().any(|(heads, _)| heads == own))
                };
                HeadSet::ALL.into_iter().filter(has).collect()
            }
        };
        let mut precisions = Vec::new();
        for precision in Precision::ALL {
            if has_precision(subject, precision)? {
                precisions.push(precision);
            }
        }
        Ok(Choices {
            levels,
            heads,
            precisions,
            threads: rayon::current_num_threads(),
        })
    }

    /// Runs everything once in each repeat.
    ///
    /// # Errors
    /// Those of [`Decoder::decode`] and of [`Renderer::render_into`].
    pub fn measure(&mut self, truth: &Truth, say: &dyn Fn(&str)) -> Result<()> {
        for repeat in 0..self.options.repeats {
            say(&format!("repeat {} of {}", repeat + 1, self.options.repeats));
            // Forwards and backwards in turns: nobody always runs after the same neighbour.
            let forwards = repeat.is_multiple_of(2);
            for i in 0..self.decodings.len() {
                let i = if forwards { i } else { self.decodings.len() - 1 - i };
                let (lap, gaussians) = self.decode(self.decodings[i].how)?;
                self.decodings[i].laps.push(lap);
                let kind = kind(&self.decodings[i].how);
                if !self.gaussians.iter().any(|(known, _)| *known == kind) {
                    self.gaussians.push((kind, gaussians));
                }
            }
            for i in 0..self.drawings.len() {
                let i = if forwards { i } else { self.drawings.len() - 1 - i };
                if repeat == 0 {
                    self.judge(i, truth)?;
                }
                let (lap, _) = self.draw(self.drawings[i].how)?;
                self.drawings[i].laps.push(lap);
            }
        }
        Ok(())
    }

    fn pool(&self, threads: usize) -> Result<&ThreadPool> {
        let mut pools = self.pools.iter();
        let found = pools.find(|(count, _)| *count == threads);
        found
            .map(|(_, pool)| pool)
            .ok_or_else(|| Error::Usage(format!("no pool of {threads} threads was made")))
    }

    fn decode(&self, how: Decode) -> Result<(Lap, Gaussians)> {
        let mut decoders = self.decoders.iter();
        let Some((_, decoder)) = decoders.find(|(other, _)| *other == how) else {
            return Err(Error::Usage("no model was loaded for this setting".into()));
        };
        let stream = self.subject.stream;
        self.pool(how.threads)?.install(|| {
            let log = Log::default();
            let decoder = decoder.clone().with_log(&log);
            let start = Instant::now();
            let gaussians = decoder.decode(stream)?;
            let mut lap = Lap {
                total: milliseconds(start),
                ..Lap::default()
            };
            for step in &log.steps() {
                lap.stages[stage_of(step)] += step.time.as_secs_f64() * 1e3;
            }
            Ok((lap, gaussians))
        })
    }

    /// The mean over all views, and their pictures.
    fn draw(&self, how: Setting) -> Result<(Lap, Vec<Image>)> {
        let mut all = self.gaussians.iter();
        let Some((_, gaussians)) = all.find(|(known, _)| *known == kind(&how.decode)) else {
            return Err(Error::Usage("nothing was decoded for this setting".into()));
        };
        let cameras = self.options.cameras(how.shrink)?;
        let limits = self.subject.limits;
        self.pool(how.decode.threads)?.install(|| {
            let renderer = Renderer::new().with_isa(how.decode.isa).with_quality(how.quality);
            let mut renderer = renderer.with_limits(limits.clone());
            let (mut lap, mut images) = (Lap::default(), Vec::new());
            for camera in &cameras {
                let mut image = Image::default();
                let mut draw = || renderer.render_into(gaussians, camera, &mut image);
                // The first brings memory and caches up to it, as when pictures follow one another.
                draw()?;
                let start = Instant::now();
                let stats = draw()?;
                lap.total += milliseconds(start);
                let times = stats.times;
                let times = [times.project, times.bin, times.sort, times.blend];
                for (sum, time) in lap.stages.iter_mut().zip(times) {
                    *sum += time.as_secs_f64() * 1e3;
                }
                images.push(image);
            }
            let count = cameras.len() as f64;
            lap.total /= count;
            lap.stages = lap.stages.map(|sum| sum / count);
            Ok((lap, images))
        })
    }

    /// Compares the pictures of a setting with what they should be.
    fn judge(&mut self, i: usize, truth: &Truth) -> Result<()> {
        let (_, images) = self.draw(self.drawings[i].how)?;
        let enlarged = |(truth, image): (&Image, &Image)| match image.width == truth.width {
            true => image.clone(),
            false => resized(image, truth.width, truth.height),
        };
        let images: Vec<Image> = truth.images.iter().zip(&images).map(enlarged).collect();
        let from_truth = truth.origin.as_ref().map(|views| from_truth(views, &images));
        let each: Vec<Distance> = truth
            .images
            .iter()
            .zip(&images)
            .map(|(truth, image)| Distance::between(truth, image))
            .collect();
        let Some((view, worst)) = (0..).zip(&each).max_by(|a, b| a.1.worst.total_cmp(&b.1.worst)) else {
            return Ok(());
        };
        let mean = |of: &dyn Fn(&Distance) -> f64| each.iter().map(of).sum::<f64>() / each.len() as f64;
        let ms_ssim = each.iter().all(|d| d.ms_ssim.is_some());
        let drawing = &mut self.drawings[i];
        drawing.view = view;
        drawing.from_truth = from_truth;
        drawing.distance = Some(Distance {
            mean_square: mean(&|d| d.mean_square),
            ms_ssim: ms_ssim.then(|| mean(&|d| d.ms_ssim.unwrap_or_default())),
            ..*worst
        });
        drawing.crop = Some(Crop::around(&truth.images[view], &images[view], worst.at, CROP));
        Ok(())
    }

    /// The pictures of the finest level, generated and drawn in double precision without any cut-off.
    ///
    /// # Errors
    /// Those of [`in_double`] and [`of_origin`].
    pub fn truth(&self, choices: &Choices, say: &dyn Fn(&str)) -> Result<Truth> {
        let level = choices.levels.last().copied().unwrap_or_default();
        say("generate Gaussians in double precision");
        let (gaussians, generate) = in_double(self.subject, level)?;
        say("draw in double precision");
        let cameras = self.options.cameras(1)?;
        let start = Instant::now();
        let images = cameras
            .iter()
            .map(|camera| reference::render(&gaussians, camera, Background::WHITE, Cutoffs::NONE))
            .collect();
        let draw = milliseconds(start) / cameras.len() as f64;
        say("draw the truth");
        let true_view = |image: Image| TrueView {
            ssimulacra2: Ssimulacra2::new(&Picture::from(&image)).ok(),
            image,
        };
        let origin = of_origin(self.subject, &cameras)?;
        Ok(Truth {
            images,
            origin: origin.map(|all| all.into_iter().map(true_view).collect()),
            generate,
            draw,
        })
    }

    /// What a setting took and how near it came.
    pub fn measured(&self, how: Setting) -> Option<Measured> {
        let decoding = self.decodings.iter().find(|d| d.how == how.decode)?;
        let drawing = self.drawings.iter().find(|d| d.how == how)?;
        let stage = |laps: &[Lap], i: usize| Spread::of(laps.iter().map(|lap| lap.stages[i]));
        let totals = decoding.laps.iter().zip(&drawing.laps);
        Some(Measured {
            stages: std::array::from_fn(|i| match i.checked_sub(STAGES.len() / 2) {
                None => stage(&decoding.laps, i),
                Some(i) => stage(&drawing.laps, i),
            }),
            decode: Spread::of(decoding.laps.iter().map(|lap| lap.total)),
            picture: Spread::of(drawing.laps.iter().map(|lap| lap.total)),
            total: Spread::of(totals.map(|(a, b)| a.total + b.total)),
            distance: drawing.distance?,
            from_truth: drawing.from_truth,
            view: drawing.view,
            memory: decoding.memory,
            crop: drawing.crop.clone(),
        })
    }
}
