//! `b2p bench`: how long each stage of decoding takes, and how near that is to what the machine can do.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use b2p::container::Header;
use b2p::gaussians::{HeadSet, Heads};
use b2p::geometry::{KernelMap, Octree};
use b2p::latents::LatentDecoder;
use b2p::latents::network::{Module, Shape, Work};
use b2p::layers::Precision;
use b2p::log::{Log, Step};
use b2p::{
    Decoder, Gaussians, Isa, Limits, SceneDecoder, SceneReader, SequenceReader, Wanted, embedded, peak_throughput,
};
use serde_json::json;

use super::args::Bench;
use super::manners::{self, Said};
use super::progress::Progress;
use super::table::{count, milliseconds, table};
use super::{Failure, Result, bench_render, load, sequence};

/// One stage's figures.
struct Line {
    step: Step,
    median: Duration,
    work: Option<Work>,
}

/// How long a run took, and its steps.
type Run = (Duration, Vec<Step>);

/// Decodes again and again; prints a table or JSON.
pub fn run(args: &Bench, limits: &Limits, progress: &Progress) -> Result<Said> {
    if args.render {
        return bench_render::run(args, limits, progress);
    }
    let bytes = match &args.input {
        Some(path) => load::bytes(path, limits)?,
        None => embedded::SCENE.to_vec(),
    };
    if SequenceReader::is_sequence(&bytes) {
        return sequence::bench(bytes, args, limits, progress);
    }
    let start = Instant::now();
    let decoder = load::decoder(&bytes, &args.detail, &args.model, limits)?;
    let loading = start.elapsed();
    let model = decoder.model();
    let fail = |error| match &args.input {
        Some(path) => Failure::in_file(path)(error),
        None => Failure::from(error),
    };
    let scene = match SceneReader::is_scene(&bytes) {
        true => Some(SceneReader::new(&bytes[..], limits).map_err(fail)?),
        false => None,
    };
    let levels = match &scene {
        Some(scene) => SceneDecoder::new(decoder.clone()).levels(scene),
        None => decoder.levels(&bytes),
    };
    let levels = levels.map_err(fail)?;
    let level = match args.detail.level {
        Some(level) => level,
        None => *levels
            .last()
            .ok_or_else(|| Failure("the stream has no level with Gaussians".into()))?,
    };

    let runs = timed(args, progress, || {
        let log = Log::new();
        let decoder = decoder.clone().with_level(level).with_log(&log);
        let start = Instant::now();
        let gaussians = match &scene {
            Some(scene) => decode_scene(scene, decoder, &log),
            None => decoder.decode(&bytes),
        };
        let gaussians = gaussians.map_err(fail)?;
        let total = start.elapsed();
        drop(gaussians);
        Ok((total, log.steps()))
    })?;
    let header = match &scene {
        Some(scene) => scene.header().clone(),
        None => Header::parse(&bytes, limits).map_err(fail)?,
    };
    let heads = decoder.heads_for(&header);
    // Of version 3, no more is known than the times.
    let works = match (model, heads.learned()) {
        (Some(model), Some(heads)) if header.model().is_some() => {
            let exact = LatentDecoder::new(model).with_limits(limits.clone());
            let exact = exact.exact(&bytes, level, &Log::default());
            let octree = exact.map_err(fail)?.octree;
            works(model.shape(), heads, &octree, header.base)
        }
        _ => HashMap::new(),
    };
    let threads = rayon::current_num_threads();
    let cores = std::thread::available_parallelism().map_or(1, |n| n.get());
    let isa = load::isa(args.model.isa.as_deref())?;
    let precision = model.map_or(Precision::Int16, |model| model.precision());
    let report = Report {
        level,
        heads,
        isa,
        precision,
        threads,
        runs: args.repeat,
        loading,
        total: median(runs.iter().map(|run| run.0)),
        lines: lines(&runs, &works),
        peak: PeakThroughput::measure(isa, precision, threads.min(cores)),
        memory: peak_memory(),
    };
    Ok(Said::result(match manners::json() {
        true => report.json(),
        false => report.text(),
    }))
}

/// The Gaussians of a scene, whose blocks are decoded in one step: those of blocks come in any order.
fn decode_scene(scene: &SceneReader<&[u8]>, decoder: Decoder, log: &Log) -> b2p::Result<Gaussians> {
    log.step("decode scene", scene.blocks().len(), "blocks", || {
        let decoder = SceneDecoder::new(decoder.with_log(&Log::default()));
        decoder.gaussians(scene, &Wanted::All)?.whole()
    })
}

/// What each run took, but for the first, which warms caches and memory up.
fn timed(args: &Bench, progress: &Progress, mut run: impl FnMut() -> Result<Run>) -> Result<Vec<Run>> {
    let mut runs = Vec::new();
    for i in 0..=args.repeat {
        progress.say(&format!("run {i} of {}", args.repeat));
        let run = run()?;
        if i > 0 {
            runs.push(run);
        }
    }
    Ok(runs)
}

/// Medians of each step over the runs.
fn lines(runs: &[Run], works: &HashMap<String, Work>) -> Vec<Line> {
    let line = |(i, step): (usize, &Step)| Line {
        step: step.clone(),
        median: median(runs.iter().map(|run| run.1[i].time)),
        work: works.get(&step.name).copied(),
    };
    runs[0].1.iter().enumerate().map(line).collect()
}

/// All that was measured.
struct Report {
    level: u8,
    heads: HeadSet,
    isa: Isa,
    precision: Precision,
    threads: usize,
    runs: u32,
    loading: Duration,
    total: Duration,
    lines: Vec<Line>,
    peak: PeakThroughput,
    memory: Option<u64>,
}

impl Report {
    fn json(&self) -> String {
        let stage = |line: &Line| {
            json!({
                "stage": line.step.name,
                "count": line.step.count,
                "unit": line.step.unit,
                "median_ms": line.median.as_secs_f64() * 1e3,
                "gmac": line.work.map(|w| w.macs as f64 / 1e9),
                "gmac_per_s": line.work.map(|w| rate(w, line.median)),
                "share_of_ceiling": self.peak.share(line),
                "mbytes": line.work.map(|w| w.bytes as f64 / 1e6),
            })
        };
        let stages: Vec<_> = self.lines.iter().map(stage).collect();
        let PeakThroughput { integers, gaussians } = self.peak;
        let report = json!({
            "level": self.level,
            "isa": self.isa.to_string(),
            "precision": self.precision.to_string(),
            "heads": self.heads.to_string(),
            "threads": self.threads,
            "runs": self.runs,
            "load_model_ms": self.loading.as_secs_f64() * 1e3,
            "decode_ms": self.total.as_secs_f64() * 1e3,
            "peak_memory_bytes": self.memory,
            "ceiling_gmac_per_s": { "integers": integers, "gaussians": gaussians },
            "stages": stages,
        });
        format!("{report:#}\n")
    }

    fn text(&self) -> String {
        let memory = self
            .memory
            .map(|bytes| format!(", peak memory {} MB", bytes / 1_000_000));
        format!(
            "level {}, {} heads, {}, {}, {} threads, medians of {} runs{}\n{}\n\
             Peak throughput, measured just now: {:.0} GMAC/s in integers, {:.0} in what Gaussians are generated in.\n\
             MB: what a stage's layers must read and write at least once.\n",
            self.level,
            self.heads,
            self.isa,
            self.precision,
            self.threads,
            self.runs,
            memory.unwrap_or_default(),
            table(&self.rows()),
            self.peak.integers,
            self.peak.gaussians,
        )
    }

    /// The table's rows, titles first.
    fn rows(&self) -> Vec<Vec<String>> {
        let titles = ["stage", "items", "", "median", "GMAC", "GMAC/s", "of ceiling", "MB"];
        let mut rows = vec![titles.map(String::from).to_vec()];
        for line in &self.lines {
            let mut row = vec![
                line.step.name.clone(),
                count(line.step.count),
                line.step.unit.into(),
                milliseconds(line.median),
            ];
            if let Some(work) = line.work {
                row.push(format!("{:.2}", work.macs as f64 / 1e9));
                row.push(format!("{:.1}", rate(work, line.median)));
                let share = self.peak.share(line).unwrap_or_default();
                row.push(format!("{:.0} %", 100.0 * share));
                row.push(format!("{:.0}", work.bytes as f64 / 1e6));
            }
            rows.push(row);
        }
        for (name, time) in [("decode, bytes to Gaussians", self.total), ("load model", self.loading)] {
            rows.push(vec![name.into(), String::new(), String::new(), milliseconds(time)]);
        }
        rows
    }
}

/// What all threads could multiply and add if nothing had to be fetched, in 10⁹ a second.
struct PeakThroughput {
    integers: f64,
    gaussians: f64,
}

impl PeakThroughput {
    fn measure(isa: Isa, precision: Precision, cores: usize) -> Self {
        let integers = cores as f64 * peak_throughput::i16(isa);
        let gaussians = match precision {
            Precision::Int16 => integers,
            Precision::F16 => cores as f64 * peak_throughput::f32(isa),
            Precision::Half => cores as f64 * peak_throughput::half(isa),
        };
        PeakThroughput { integers, gaussians }
    }

    /// How near a stage came.
    fn share(&self, line: &Line) -> Option<f64> {
        let ceiling = match line.step.name.starts_with("generate") {
            true => self.gaussians,
            false => self.integers,
        };
        line.work.map(|work| rate(work, line.median) / ceiling)
    }
}

/// What the modules of the network compute, by the names of their steps.
fn works(shape: &Shape, heads: Heads, octree: &Octree, base: u8) -> HashMap<String, Work> {
    let mut works = HashMap::new();
    let mut map = KernelMap::root();
    for level in 0..=octree.depth() {
        if level > 0 {
            map = octree.child_map(level - 1, &map);
        }
        if let Some(role) = level.checked_sub(base).map(usize::from) {
            let mut modules = vec![Module::Features(role)];
            if role > 0 {
                modules.extend([Module::Context(role), Module::Probabilities(role)]);
            }
            if level == octree.depth() {
                modules.push(Module::Gaussians(role, heads));
            }
            works.extend(modules.iter().map(|m| (m.at(level), shape.work(*m, &map))));
        }
    }
    works
}

/// 10⁹ multiply–accumulates a second.
fn rate(work: Work, time: Duration) -> f64 {
    work.macs as f64 / 1e9 / time.as_secs_f64().max(1e-9)
}

pub fn median(times: impl Iterator<Item = Duration>) -> Duration {
    let mut times: Vec<Duration> = times.collect();
    times.sort_unstable();
    times[times.len() / 2]
}

/// The most memory that this process ever held, where the system tells.
pub fn peak_memory() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    let kilobytes: u64 = line.split_whitespace().nth(1)?.parse().ok()?;
    Some(kilobytes * 1024)
}
