//! `--budget`: level and heads chosen by what they cost on this machine.

mod calibration;
mod choice;
mod costs;
mod measure;

use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};
use std::time::Duration;

use b2p::container::{Header, version};
use b2p::gaussians::HeadSet;
use b2p::gaussians::learned::HeadsModel;
use b2p::latents::network::Model;
use b2p::{Decoder, Encoder, Isa, Limits, embedded};
use clap::Args;

use self::calibration::{Calibration, CalibrationKey};
use self::choice::Choice;
pub use self::choice::Task;
use self::measure::{Sample, measure};
use super::args::{DetailArg, ModelArg};
use super::pipe::PIPE;
use super::progress::Progress;
use super::table::milliseconds;
use super::{Failure, Result, data, load, manners};

/// A time instead of level and heads.
#[derive(Debug, Args)]
#[command(next_help_heading = "Budget")]
pub struct BudgetArgs {
    /// Time that it may take, such as 33ms or 0.5s: level and heads are those that look best among all that fit, by
    /// what they cost on this machine, which is measured at the first use and kept in the user's cache folder.
    /// Decoding: from the stream in memory to Gaussians. Drawing: from the stream in memory to a picture
    #[arg(long, value_name = "TIME", value_parser = time, conflicts_with_all = ["level", "precision", "per_voxel"])]
    pub budget: Option<Duration>,
    /// Measure this machine again
    #[arg(long)]
    pub calibrate: bool,
}

impl BudgetArgs {
    /// Whether anything is asked for.
    pub fn is_given(&self) -> bool {
        self.calibrate || self.budget.is_some()
    }
}

/// What a choice is made for.
pub struct Request<'a> {
    pub args: &'a BudgetArgs,
    pub detail: &'a DetailArg,
    pub model: &'a ModelArg,
    pub limits: &'a Limits,
    pub progress: &'a Progress,
}

/// A choice that was made, and what it was made for.
pub struct Chosen {
    choice: Choice,
    time: Duration,
    machine: Machine,
}

/// What is calibrated: this machine, with a model.
struct Machine {
    stream: Vec<u8>,
    model: Vec<u8>,
    version: u16,
    isa: Isa,
}

/// The stream of a file that a budget is for; none if no budget is asked for.
pub fn stream(args: &BudgetArgs, input: &Path, detail: &DetailArg, limits: &Limits) -> Result<Option<Vec<u8>>> {
    if !args.is_given() {
        return Ok(None);
    }
    if input == Path::new(PIPE) {
        return Err(Failure("a budget is for files: what a pipe brings is not known".into()));
    }
    let stream = load::bytes(input, limits)?;
    if stream.starts_with(load::PLY_MAGIC) {
        let what = "a budget is for streams, this is a PLY";
        return Err(Failure(format!("{}: {what}", input.display())));
    }
    load::whole_levels(input, stream, detail, limits).map(Some)
}

/// The choice for a stream; none if only a calibration was asked for. No level finer than `finest` is taken.
pub fn choose(
    request: &Request,
    input: &Path,
    stream: &[u8],
    finest: Option<u8>,
    task: Task,
) -> Result<Option<Chosen>> {
    let Request {
        args,
        detail,
        model,
        limits,
        progress,
    } = *request;
    let fail = Failure::in_file(input);
    let header = Header::parse(stream, limits).map_err(&fail)?;
    let decoder = load::decoder(stream, detail, model, limits)?;
    let mut levels = decoder.levels(stream).map_err(&fail)?;
    levels.retain(|level| finest.is_none_or(|finest| *level <= finest));
    let machine = Machine::new(stream, model, limits)?;
    let calibration = machine.calibration(args.calibrate, limits, progress)?;
    let Some(time) = args.budget else { return Ok(None) };
    let all = choice::choices(&calibration, &header, &levels, detail.heads, task).map_err(&fail)?;
    Ok(choice::choose(&all, time).map(|choice| Chosen { choice, time, machine }))
}

impl Machine {
    fn new(stream: &[u8], model: &ModelArg, limits: &Limits) -> Result<Machine> {
        let version = version(stream).unwrap_or_default();
        let path = model.model.as_ref();
        let file = |path: &PathBuf| load::bytes(path, limits);
        let own = || match version {
            2 => data::model(),
            _ => Ok(embedded::HEADS.into()),
        };
        let sample = match (version, path) {
            // The sample is the program's own model's; another model is measured with the stream at hand.
            (2, None) => data::SAMPLE.unwrap_or(stream),
            (2, Some(_)) => stream,
            _ => embedded::SCENE,
        };
        Ok(Machine {
            stream: sample.to_vec(),
            model: path.map_or_else(|| own().map(Into::into), file)?,
            version,
            isa: load::isa(model.isa.as_deref())?,
        })
    }

    fn key(&self) -> CalibrationKey {
        let mut hasher = DefaultHasher::new();
        self.model.hash(&mut hasher);
        // A stream of the user's is one of many, and as good as any other.
        self.version.hash(&mut hasher);
        CalibrationKey {
            isa: self.isa.to_string(),
            model: format!("{:016x}", hasher.finish()),
        }
    }

    /// What was kept, or what is measured now and kept where that is possible.
    fn calibration(&self, again: bool, limits: &Limits, progress: &Progress) -> Result<Calibration> {
        let key = self.key();
        let path = Calibration::path(&key);
        let kept = path.as_deref().filter(|_| !again);
        if let Some(kept) = kept.and_then(|path| Calibration::load(path, &key)) {
            return Ok(kept);
        }
        let calibration = self.measure(key, limits, progress)?;
        match path.map(|path| calibration.save(&path)) {
            None => manners::warn("no folder for the calibration is known, it is not kept"),
            Some(Err(error)) => manners::warn(&format!("the calibration is not kept: {error}")),
            Some(Ok(())) => {}
        }
        Ok(calibration)
    }

    /// What is measured with: the stream, and before it, if it has version 3, one of its coarsest level.
    fn streams(&self, decoder: &dyn Fn() -> b2p::Result<Decoder>) -> Result<Vec<Vec<u8>>> {
        let own = self.stream.clone();
        let Some(&coarsest) = decoder()?.levels(&own)?.first().filter(|_| self.version > 2) else {
            return Ok(vec![own]);
        };
        let decoding = decoder()?.with_level(coarsest).whole(&own)?;
        let Some(points) = decoding.points() else {
            return Ok(vec![own]);
        };
        let coarse = Encoder::new().with_isa(self.isa).encode(&points.to_voxels())?;
        Ok(vec![coarse.bytes, own])
    }

    fn measure(&self, key: CalibrationKey, limits: &Limits, progress: &Progress) -> Result<Calibration> {
        let decoder = || {
            let decoder = Decoder::new().with_isa(self.isa).with_limits(limits.clone());
            Ok(match self.version {
                2 => decoder.with_model(Model::from_bytes(&self.model)?.with_isa(self.isa)),
                _ => decoder.with_heads_model(HeadsModel::from_bytes(&self.model)?),
            })
        };
        let has = |heads: HeadSet| -> Result<bool> {
            Ok(match (self.version, heads.learned()) {
                (2, None) => false,
                (2, Some(heads)) => Model::from_bytes(&self.model)?.shape().heads().contains(&heads),
                (_, None) => true,
                (_, Some(heads)) => HeadsModel::from_bytes(&self.model)?.sets().any(|set| set.0 == heads),
            })
        };
        let mut heads = Vec::new();
        for set in HeadSet::ALL {
            if has(set)? {
                heads.push(set);
            }
        }
        let streams = self.streams(&decoder)?;
        let sample = Sample {
            streams: &streams,
            decoder: &decoder,
            heads: &heads,
            isa: self.isa,
            limits,
        };
        Ok(measure(&sample, key, &|step| progress.say(step))?)
    }
}

impl Chosen {
    /// The arguments that the choice stands for.
    pub fn detail(&self) -> DetailArg {
        DetailArg {
            level: Some(self.choice.level),
            heads: Some(self.choice.heads),
            per_voxel: None,
        }
    }

    /// The choice in words, and whether the time was kept by something that took `took`. If that is far from what was
    /// expected, the machine is measured again, unless that was done a moment ago.
    pub fn describe(&self, took: Duration, limits: &Limits, progress: &Progress) -> Result<String> {
        let mut text = self.words(took);
        let path = Calibration::path(&self.machine.key());
        if self.choice.is_off(took) && path.is_some_and(|path| Calibration::may_be_retaken(&path)) {
            self.machine.calibration(true, limits, progress)?;
            text += "budget: far from what was expected, the machine was measured again\n";
        }
        Ok(text)
    }

    fn words(&self, took: Duration) -> String {
        let Choice {
            level, heads, expected, ..
        } = self.choice;
        let [expected, took_ms, time] = [expected, took, self.time].map(milliseconds);
        let told = match (self.choice.fits(self.time), took <= self.time) {
            (false, _) => format!("no setting fits {time}; took {took_ms}"),
            (true, true) => format!("kept: {took_ms} of {time}"),
            (true, false) => format!("not kept: {took_ms} of {time}"),
        };
        format!("budget: level {level}, {heads}, expected {expected}; {told}\n")
    }
}

/// A time such as 33ms or 0.5s.
fn time(text: &str) -> std::result::Result<Duration, String> {
    let expected = "expected a time above 0 such as 33ms or 0.5s";
    let (number, unit) = match text.strip_suffix("ms") {
        Some(number) => (number, 1e-3),
        None => (text.strip_suffix('s').ok_or(expected)?, 1.0),
    };
    let number: f64 = number.parse().map_err(|_| expected)?;
    let time = Duration::try_from_secs_f64(number * unit).map_err(|_| expected)?;
    match time.is_zero() {
        true => Err(expected.into()),
        false => Ok(time),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_read_as_written_and_nonsense_is_refused_with_an_example() {
        assert_eq!(time("33ms"), Ok(Duration::from_millis(33)));
        assert_eq!(time("0.5s"), Ok(Duration::from_millis(500)));
        for nonsense in ["", "33", "ms", "-1s", "0ms", "NaNs", "infs", "1e99s"] {
            assert!(time(nonsense).unwrap_err().contains("33ms"), "{nonsense}");
        }
    }
}
