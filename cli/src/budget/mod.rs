//! `--budget` and `--min-psnr`: level, precision and quality chosen by what they cost on this machine.

mod calibration;
mod choice;
mod measure;

use std::path::Path;
use std::time::Duration;

use b2p::container::Header;
use b2p::gaussians::Heads;
use b2p::latents::LatentDecoder;
use b2p::latents::network::Model;
use b2p::{Limits, embedded};
use clap::Args;

use self::calibration::Calibration;
pub use self::choice::Task;
use self::choice::{Budget, CalibrationInput, Choice};
use super::args::{DetailArg, ModelArg};
use super::pipe::PIPE;
use super::progress::Progress;
use super::table::milliseconds;
use super::{Failure, Result, load};

/// A time or an accuracy instead of level, precision and quality.
#[derive(Debug, Args)]
#[command(next_help_heading = "Budget")]
pub struct BudgetArgs {
    /// Time that it may take, such as 33ms or 0.5s: level, precision and quality are chosen by what they cost on this
    /// machine, which is measured at the first use and kept in the user's cache folder. Decoding: from the stream in
    /// memory to Gaussians. Drawing: from Gaussians to each picture
    #[arg(long, value_name = "TIME", value_parser = time, conflicts_with_all = ["level", "precision", "heads"])]
    pub budget: Option<Duration>,
    /// Least PSNR in dB against double precision, as it was for the sample
    #[arg(long, value_name = "DB", value_parser = decibel, conflicts_with_all = ["level", "precision", "heads"])]
    pub min_psnr: Option<f64>,
    /// Measure this machine again
    #[arg(long)]
    pub calibrate: bool,
}

impl BudgetArgs {
    /// Whether anything is asked for.
    pub fn is_given(&self) -> bool {
        self.calibrate || self.budget.is_some() || self.min_psnr.is_some()
    }
}

/// A choice that was made, and what it was made for.
pub struct Chosen {
    pub choice: Choice,
    budget: Budget,
}

/// The choice for a file; none if nothing was asked for.
pub fn choose(
    args: &BudgetArgs,
    model_arg: &ModelArg,
    input: &Path,
    task: Task,
    limits: &Limits,
    progress: &Progress,
) -> Result<Option<Chosen>> {
    let budget = Budget {
        time: args.budget,
        min_psnr: args.min_psnr,
    };
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
    let model = load::model(model_arg)?;
    let fail = Failure::in_file(input);
    let header = Header::parse(&stream, limits).map_err(&fail)?;
    header.check_model(&model.id()).map_err(&fail)?;
    // The sample is the program's own model's; another model is measured with the stream at hand.
    let known = match model_arg.model {
        None => embedded::SAMPLE,
        Some(_) => &stream[..],
    };
    let calibration = calibration(args, &model, known, model_arg, limits, progress)?;
    if budget == Budget::default() {
        return Ok(None);
    }
    let decoder = LatentDecoder::new(&model).with_limits(limits.clone());
    let levels = decoder.levels(&stream).map_err(&fail)?;
    let choice = budget.choose(&calibration, &header, &levels, task).map_err(&fail)?;
    Ok(Some(Chosen { choice, budget }))
}

/// What was kept, or what is measured now and kept where that is possible.
fn calibration(
    args: &BudgetArgs,
    model: &Model,
    stream: &[u8],
    model_arg: &ModelArg,
    limits: &Limits,
    progress: &Progress,
) -> Result<Calibration> {
    let path = Calibration::path(model);
    let kept = path.as_deref().filter(|_| !args.calibrate);
    if let Some(kept) = kept.and_then(|path| Calibration::load(path, model)) {
        return Ok(kept);
    }
    let file = match &model_arg.model {
        Some(path) => load::bytes(path, limits)?,
        None => embedded::MODEL.to_vec(),
    };
    let subject = CalibrationInput {
        stream,
        model: &|| Ok(Model::from_bytes(&file)?.with_isa(model.isa())),
        limits,
    };
    let calibration = Calibration::measure(&subject, &|step| progress.say(step))?;
    match path.map(|path| calibration.save(&path)) {
        None => super::manners::warn("no folder for the calibration is known, it is not kept"),
        Some(Err(error)) => super::manners::warn(&format!("the calibration is not kept: {error}")),
        Some(Ok(())) => {}
    }
    Ok(calibration)
}

impl Chosen {
    /// The arguments that the choice stands for.
    pub fn detail(&self) -> DetailArg {
        DetailArg {
            level: Some(self.choice.level),
            heads: Some(self.choice.heads.into()),
            per_voxel: None,
        }
    }

    /// The model as chosen.
    pub fn model(&self, model: &ModelArg) -> ModelArg {
        ModelArg {
            precision: Some(self.choice.precision.to_string()),
            ..model.clone()
        }
    }

    /// The choice in words, and whether what it was made for was kept by something that took `took`.
    pub fn describe(&self, task: Task, took: Duration) -> String {
        let Choice {
            level,
            heads,
            precision,
            quality,
            expected,
            psnr,
            ..
        } = self.choice;
        let quality = match task {
            Task::Decode => String::new(),
            Task::Picture { .. } => format!(", {}", quality),
        };
        let heads = match heads {
            Heads::Best => String::new(),
            heads => format!("{heads} heads, "),
        };
        let mut text = format!(
            "budget: level {level}, {heads}{precision}{quality}; expected {} and {psnr:.1} dB",
            milliseconds(expected)
        );
        if let Some(least) = self.budget.min_psnr
            && !self.choice.accurate
        {
            text += &format!(", not the {least} dB asked for");
        }
        if let Some(time) = self.budget.time
            && !self.choice.in_time
        {
            text += &format!(", no setting fits {}", milliseconds(time));
        }
        text += &match self.budget.time {
            None => format!("; took {}", milliseconds(took)),
            Some(time) if took <= time => {
                format!("; kept: {} of {}", milliseconds(took), milliseconds(time))
            }
            Some(_) if !self.choice.in_time => format!("; took {}", milliseconds(took)),
            Some(time) => {
                format!("; not kept: {} of {}", milliseconds(took), milliseconds(time))
            }
        };
        text + "\n"
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

fn decibel(text: &str) -> std::result::Result<f64, String> {
    match text.parse() {
        Ok(db) if (0.0..=200.0).contains(&db) => Ok(db),
        _ => Err("expected a number from 0 to 200".into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_and_accuracies_are_read_as_written_and_nonsense_is_refused_with_an_example() {
        assert_eq!(time("33ms"), Ok(Duration::from_millis(33)));
        assert_eq!(time("0.5s"), Ok(Duration::from_millis(500)));
        assert_eq!(decibel("40"), Ok(40.0));
        for nonsense in ["", "33", "ms", "-1s", "0ms", "NaNs", "infs", "1e99s"] {
            assert!(time(nonsense).unwrap_err().contains("33ms"), "{nonsense}");
        }
        assert!(decibel("NaN").is_err() && decibel("-1").is_err());
    }
}
