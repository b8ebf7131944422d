//! `b2p plan`: a job of many files as work for an engine that distributes it. A unit of work is one command line of
//! this program, which can be repeated: with `--resume`, nothing is done twice.

mod openjd;
mod ray;
mod slurm;
mod steps;

use std::path::{Path, PathBuf, absolute};

use b2p::{Error, output};
use clap::{Args, ValueEnum};
use serde::Deserialize;
use serde_json::json;

use super::manners::{self, Said};
use super::many::expanded;
use super::table::counted;
use super::{Failure, Result, encode, render};
use steps::Step;

/// Arguments of `plan`.
#[derive(Debug, Args)]
pub struct Plan {
    /// Job in TOML, with the long options of this command as keys
    #[arg(value_name = "JOB")]
    pub job: Option<PathBuf>,
    /// Folder that the plan is written into
    #[arg(short, long, value_name = "DIR")]
    pub output: PathBuf,
    /// Engine: Open Job Description, a Slurm cluster, or Ray
    #[arg(long, value_enum, value_name = "NAME")]
    pub engine: Engine,
    #[command(flatten)]
    pub options: Job,
}

/// What distributes the work.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Engine {
    /// A job template of the Open Job Description, version 2023-09
    Openjd,
    /// Array jobs, and a script that submits them
    Slurm,
    /// A Python program
    Ray,
}

/// What is to be done. Everything in a file of a job may be said as an option as well, which has precedence.
#[derive(Debug, Default, Args, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct Job {
    /// Point clouds, or with no `encode` streams or Gaussians: files, folders or patterns
    #[arg(long, value_name = "IN", num_args = 1..)]
    #[serde(default)]
    inputs: Vec<PathBuf>,
    /// Folder for the folders `streams`, `pictures`, `sheets` and `videos`
    #[arg(long, value_name = "DIR")]
    to: Option<PathBuf>,
    /// Encode the inputs, with these options of `encode`
    #[arg(long, value_name = "OPTIONS", allow_hyphen_values = true)]
    encode: Option<String>,
    /// Options of `render`
    #[arg(long, value_name = "OPTIONS", allow_hyphen_values = true)]
    render: Option<String>,
    /// Pictures of each file, once around [default: 1]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    views: Option<u32>,
    /// Elevation of the camera in degrees [default: 20]
    #[arg(long, value_name = "DEG", allow_negative_numbers = true)]
    elevation: Option<f32>,
    /// Also draw a contact sheet of each file
    #[arg(long)]
    #[serde(default)]
    contact_sheet: bool,
    /// Also draw a video of one turn around each file: gif, webp, png, mp4, webm or mkv
    #[arg(long, value_name = "ENDING")]
    video: Option<String>,
    /// Files of a unit of work [default: 16]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    group: Option<u32>,
    /// Threads of a unit of work [default: 2]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    cores: Option<u16>,
    /// This program, as it is called where the work is done
    #[arg(long, value_name = "FILE")]
    program: Option<String>,
}

/// A job as engines get it.
#[derive(Debug)]
struct Work {
    /// Where the plan is.
    folder: PathBuf,
    program: String,
    /// Threads of a unit of work.
    cores: u16,
    steps: Vec<Step>,
}

/// Names and contents of files.
type Texts = Vec<(String, String)>;

/// Writes a plan.
pub fn run(args: &mut Plan) -> Result<Said> {
    let job = match &args.job {
        Some(path) => std::mem::take(&mut args.options).over(read(path)?),
        None => std::mem::take(&mut args.options),
    };
    let folder = path(&args.output)?;
    let (work, mut files) = job.work(folder)?;
    let how = match args.engine {
        Engine::Openjd => openjd::files(&work, &mut files)?,
        Engine::Slurm => slurm::files(&work, &mut files)?,
        Engine::Ray => ray::files(&work, &mut files),
    };
    for step in &work.steps {
        files.push((format!("{}.txt", step.name), step.commands(&work.program)));
    }
    let paths: Vec<PathBuf> = files.iter().map(|(name, _)| work.folder.join(name)).collect();
    let outputs: Vec<&Path> = paths.iter().map(PathBuf::as_path).collect();
    let inputs: Vec<&Path> = args.job.iter().map(PathBuf::as_path).collect();
    manners::permit(&outputs, &inputs)?;
    for (path, (_, text)) in paths.iter().zip(&files) {
        write(path, text)?;
    }
    let units: usize = work.steps.iter().map(Step::units).sum();
    let report = format!("{}: {}\n{how}\n", work.folder.display(), counted(units as u64, "unit"));
    let json = || {
        let steps = work
            .steps
            .iter()
            .map(|step| json!({"name": step.name, "units": step.units()}));
        json!({"folder": work.folder, "steps": steps.collect::<Vec<_>>(), "run": how})
    };
    Ok(Said::report(report, json))
}

fn read(path: &Path) -> Result<Job> {
    let fail = |error: &dyn std::fmt::Display| Failure(format!("{}: {error}", path.display()));
    let text = std::fs::read_to_string(path).map_err(|error| fail(&error))?;
    toml::from_str(&text).map_err(|error| fail(&error))
}

/// An absolute path: workers have folders of their own.
fn path(path: &Path) -> Result<PathBuf> {
    absolute(path).map_err(|error| Failure(format!("{}: {error}", path.display())))
}

fn write(path: &Path, text: &str) -> Result<()> {
    let fail = |source| Error::Io {
        path: path.to_path_buf(),
        source,
    };
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder).map_err(fail)?;
    }
    Ok(output::write_file(path, |w| {
        w.write_all(text.as_bytes()).map_err(fail)
    })?)
}

impl Job {
    /// These options, and from `file` what they leave open.
    fn over(self, file: Job) -> Job {
        Job {
            inputs: if self.inputs.is_empty() {
                file.inputs
            } else {
                self.inputs
            },
            to: self.to.or(file.to),
            encode: self.encode.or(file.encode),
            render: self.render.or(file.render),
            views: self.views.or(file.views),
            elevation: self.elevation.or(file.elevation),
            contact_sheet: self.contact_sheet || file.contact_sheet,
            video: self.video.or(file.video),
            group: self.group.or(file.group),
            cores: self.cores.or(file.cores),
            program: self.program.or(file.program),
        }
    }

    /// The steps, and lists of the files of each group.
    fn work(&self, folder: PathBuf) -> Result<(Work, Texts)> {
        let to = self.to.as_deref();
        let to = path(to.ok_or_else(|| Failure("no folder for the results: --to DIR".into()))?)?;
        let takes = match self.encode {
            Some(_) => encode::KIND.takes,
            None => render::TAKES,
        };
        let inputs = expanded(&self.inputs, takes)?;
        if inputs.is_empty() {
            return Err(Failure("no inputs: --inputs FILES".into()));
        }
        let inputs = inputs.iter().map(|input| path(input)).collect::<Result<Vec<_>>>()?;
        let streams = |input: &PathBuf| -> PathBuf {
            let mut name = input.file_stem().unwrap_or_default().to_owned();
            name.push(".b2p");
            to.join("streams").join(name)
        };
        let size = self.group.unwrap_or(16) as usize;
        let mut lists = Texts::new();
        let mut steps = Vec::new();
        let mut drawn = inputs.clone();
        if let Some(options) = &self.encode {
            add_lists(&mut lists, "clouds", &inputs, size)?;
            steps.push(Step::encode(words("encode", options)?, &to, &folder));
            drawn = inputs.iter().map(streams).collect();
        }
        let mut names: Vec<_> = drawn.iter().map(|path| path.file_stem()).collect();
        names.sort();
        if let Some([same, _]) = names.array_windows().find(|[a, b]| a == b) {
            let name = same.unwrap_or_default().display();
            return Err(Failure(format!(
                "two inputs are named {name}: their results would be the same files"
            )));
        }
        add_lists(&mut lists, "drawn", &drawn, size)?;
        let options = words("render", self.render.as_deref().unwrap_or_default())?;
        let elevation = self.elevation.unwrap_or(20.0);
        let views = self.views.unwrap_or(1);
        let after = steps.last().map(|step: &Step| step.name);
        steps.push(Step::render(&options, views, elevation, &to, &folder, after));
        if self.contact_sheet {
            steps.push(Step::sheet(&options, views, elevation, &to, &folder));
        }
        if let Some(ending) = &self.video {
            steps.push(Step::video(&options, ending, elevation, &to, &folder));
        }
        let groups = inputs.len().div_ceil(size);
        steps.iter_mut().for_each(|step| step.groups = groups);
        let work = Work {
            folder,
            program: self.program.clone().unwrap_or_else(|| "b2p".into()),
            cores: self.cores.unwrap_or(2),
            steps: steps
                .into_iter()
                .map(|step| step.with_threads(self.cores.unwrap_or(2)))
                .collect(),
        };
        Ok((work, lists))
    }
}

/// Writes which files the groups have.
fn add_lists(lists: &mut Texts, name: &str, files: &[PathBuf], size: usize) -> Result<()> {
    for (group, files) in files.chunks(size).enumerate() {
        let mut text = String::new();
        for file in files {
            let file = file.to_str().filter(|file| !file.contains('\n'));
            let file = file.ok_or_else(|| Failure("a file's name is no line of UTF-8".into()))?;
            text += file;
            text.push('\n');
        }
        lists.push((format!("lists/{name}-{group}.txt"), text));
    }
    Ok(())
}

/// Options as a shell reads them.
fn words(name: &str, options: &str) -> Result<Vec<String>> {
    shlex::split(options).ok_or_else(|| Failure(format!("{name}: {options:?} has an open quotation mark")))
}
