//! `b2p bench` of a sequence: how long each stage of decoding its frames takes.

use std::time::{Duration, Instant};

use b2p::log::Log;
use b2p::{Decoder, Limits, SequenceDecoder, SequenceReader};
use serde_json::json;

use super::super::args::Bench;
use super::super::bench::{median, peak_memory};
use super::super::manners::{self, Said};
use super::super::progress::Progress;
use super::super::table::{count, counted, milliseconds, table};
use super::super::{Failure, Result, load};

/// What one run over all frames took.
#[derive(Default)]
struct Run {
    /// From bytes to voxels with colours.
    voxels: Duration,
    /// From those to Gaussians.
    gaussians: Duration,
    stages: Vec<Stage>,
}

/// The steps of one name, of all frames together.
struct Stage {
    name: String,
    count: u64,
    unit: &'static str,
    time: Duration,
}

/// Decodes all frames again and again, one after the other; prints a table or JSON.
pub fn run(bytes: Vec<u8>, args: &Bench, limits: &Limits, progress: &Progress) -> Result<Said> {
    let fail = |error| match &args.input {
        Some(path) => Failure::in_file(path)(error),
        None => Failure::from(error),
    };
    let sequence = SequenceReader::new(bytes, limits).map_err(fail)?;
    let decoder = load::decoder(&[], &args.detail, &args.model, limits)?;
    let mut runs = Vec::new();
    let mut level = None;
    for i in 0..=args.repeat {
        progress.say(&format!("run {i} of {}", args.repeat));
        let (run, decoded) = decode(&sequence, &decoder).map_err(fail)?;
        level = decoded;
        // The first run warms caches and memory up.
        if i > 0 {
            runs.push(run);
        }
    }
    let report = Report {
        frames: sequence.frames(),
        level,
        heads: decoder.heads_for(sequence.header()).to_string(),
        isa: load::isa(args.model.isa.as_deref())?.to_string(),
        runs,
    };
    Ok(Said::result(match manners::json() {
        true => report.json(),
        false => report.text(),
    }))
}

/// Decodes all frames and makes their Gaussians. Returns the level, too.
fn decode(sequence: &SequenceReader, decoder: &Decoder) -> b2p::Result<(Run, Option<u8>)> {
    let (mut run, mut level) = (Run::default(), None);
    let log = Log::new();
    let mut frames = SequenceDecoder::new(decoder.clone().with_log(&log));
    for number in 0..sequence.frames() {
        let start = Instant::now();
        let frame = frames.frame(sequence, number)?;
        let decoded = Instant::now();
        frame.gaussians()?;
        run.voxels += decoded - start;
        run.gaussians += decoded.elapsed();
        level = frame.level();
    }
    for step in log.steps() {
        match run.stages.iter_mut().find(|stage| stage.name == step.name) {
            Some(stage) => {
                stage.count += step.count;
                stage.time += step.time;
            }
            None => run.stages.push(Stage {
                name: step.name,
                count: step.count,
                unit: step.unit,
                time: step.time,
            }),
        }
    }
    Ok((run, level))
}

/// All that was measured.
struct Report {
    frames: u64,
    level: Option<u8>,
    heads: String,
    isa: String,
    runs: Vec<Run>,
}

impl Report {
    /// What a frame takes, from the median over the runs.
    fn a_frame(&self, time: impl Fn(&Run) -> Duration) -> Duration {
        median(self.runs.iter().map(time)).div_f64(self.frames.max(1) as f64)
    }

    /// Its three parts: voxels with colours, Gaussians, and both.
    fn parts(&self) -> [(&'static str, Duration); 3] {
        [
            ("bytes to voxels with colours", self.a_frame(|run| run.voxels)),
            ("voxels to Gaussians", self.a_frame(|run| run.gaussians)),
            ("a frame", self.a_frame(|run| run.voxels + run.gaussians)),
        ]
    }

    /// The stages, and what they take of a frame.
    fn stages(&self) -> impl Iterator<Item = (&Stage, Duration)> {
        let first = self.runs.first().map_or(&[][..], |run| &run.stages);
        first.iter().map(|stage| {
            // Steps that run at the same time may end in another order.
            let of_run = |run: &Run| {
                run.stages
                    .iter()
                    .find(|other| other.name == stage.name)
                    .map(|other| other.time)
            };
            (stage, self.a_frame(|run| of_run(run).unwrap_or_default()))
        })
    }

    fn json(&self) -> String {
        let ms = |time: Duration| time.as_secs_f64() * 1e3;
        let stages: Vec<_> = self
            .stages()
            .map(|(stage, time)| {
                json!({
                    "stage": stage.name,
                    "count": stage.count as f64 / self.frames as f64,
                    "unit": stage.unit,
                    "median_ms": ms(time),
                })
            })
            .collect();
        let [voxels, gaussians, frame] = self.parts().map(|part| ms(part.1));
        let report = json!({
            "frames": self.frames,
            "level": self.level,
            "heads": self.heads,
            "isa": self.isa,
            "threads": rayon::current_num_threads(),
            "runs": self.runs.len(),
            "voxels_ms": voxels,
            "gaussians_ms": gaussians,
            "frame_ms": frame,
            "peak_memory_bytes": peak_memory(),
            "stages": stages,
        });
        format!("{report:#}\n")
    }

    fn text(&self) -> String {
        let titles = ["stage", "items", "", "time of a frame"];
        let mut rows = vec![titles.map(String::from).to_vec()];
        for (stage, time) in self.stages() {
            let items = count(stage.count / self.frames.max(1));
            rows.push(vec![stage.name.clone(), items, stage.unit.into(), milliseconds(time)]);
        }
        for (name, time) in self.parts() {
            rows.push(vec![name.into(), String::new(), String::new(), milliseconds(time)]);
        }
        let level = self.level.map_or_else(String::new, |level| format!("level {level}, "));
        let memory = peak_memory().map(|bytes| format!(", peak memory {} MB", bytes / 1_000_000));
        format!(
            "{}, {level}{} heads, {}, {} threads, means over the frames, medians of {} runs{}\n{}\n\
             One frame after the other. `render` and `play` decode a frame while they draw the one before.\n",
            counted(self.frames, "frame"),
            self.heads,
            self.isa,
            rayon::current_num_threads(),
            self.runs.len(),
            memory.unwrap_or_default(),
            table(&rows),
        )
    }
}
