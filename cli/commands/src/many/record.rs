//! `--resume`: what was done before is not done again.
//!
//! Beside its outputs, in the folder `.b2p`, a command keeps a record of its options and of the hashes of its inputs and
//! outputs. If they are all as they were, there is nothing to do. Times do not matter.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use b2p::{Error, embedded, output};
use serde::{Deserialize, Serialize};
use xxhash_rust::xxh3::Xxh3;

use super::super::pipe::PIPE;
use super::super::{Result, data};
use super::command_line::CommandLine;

/// Options that change how a command works, but not what it writes.
const IRRELEVANT: [&str; 13] = [
    "--resume",
    "--force",
    "-f",
    "--quiet",
    "-q",
    "--verbose",
    "-v",
    "--json",
    "--stats",
    "--color",
    "--max-memory",
    "--limits",
    "--turntable",
];

/// What a command did.
#[derive(Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Record {
    /// Version of the program, and the hash of the models in it.
    program: String,
    /// Its options.
    options: Vec<String>,
    inputs: Vec<File>,
    outputs: Vec<File>,
}

/// A file as it was.
#[derive(Debug, PartialEq, Eq, Serialize, Deserialize)]
struct File {
    path: PathBuf,
    bytes: u64,
    /// XXH3 of 128 bits.
    hash: String,
}

impl Record {
    /// Of files as they are now. None if one of them is missing, or is no file.
    pub fn of(options: &[String], inputs: &[PathBuf], outputs: &[PathBuf]) -> Option<Record> {
        let files = |paths: &[PathBuf]| paths.iter().map(|path| File::of(path)).collect::<Option<Vec<_>>>();
        Some(Record {
            program: program(),
            options: options.to_vec(),
            inputs: files(inputs)?,
            outputs: files(outputs)?,
        })
    }

    /// The record of an output, if it has one that can be read.
    pub fn read(output: &Path) -> Option<Record> {
        serde_json::from_slice(&std::fs::read(place(output)).ok()?).ok()
    }

    /// Writes it beside its first output.
    pub fn write(&self) -> Result<()> {
        let Some(first) = self.outputs.first() else {
            return Ok(());
        };
        let path = place(&first.path);
        let fail = |source| Error::Io {
            path: path.clone(),
            source,
        };
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder).map_err(fail)?;
        }
        let text = serde_json::to_vec_pretty(self).map_err(|error| fail(error.into()))?;
        Ok(output::write_file(&path, |w| w.write_all(&text).map_err(fail))?)
    }
}

impl File {
    fn of(path: &Path) -> Option<File> {
        if path == Path::new(PIPE) || !path.is_file() {
            return None;
        }
        let (bytes, hash) = content_hash(path)?;
        Some(File {
            path: path.to_path_buf(),
            bytes,
            hash,
        })
    }
}

/// Length and hash of what a file contains; none if it cannot be read.
pub fn content_hash(path: &Path) -> Option<(u64, String)> {
    let mut hash = Hash(Xxh3::new());
    let bytes = std::io::copy(&mut std::fs::File::open(path).ok()?, &mut hash).ok()?;
    Some((bytes, format!("{:032x}", hash.0.digest128())))
}

struct Hash(Xxh3);

impl Write for Hash {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.update(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

/// What this program is: other models draw other pictures.
pub fn program() -> String {
    static PROGRAM: OnceLock<String> = OnceLock::new();
    let name = || {
        let mut hash = Hash(Xxh3::new());
        // Without a model, learned streams give an error, which leaves no record.
        let _ = data::identify_model(&mut hash);
        hash.0.update(embedded::HEADS);
        format!("{} {:032x}", env!("CARGO_PKG_VERSION"), hash.0.digest128())
    };
    PROGRAM.get_or_init(name).clone()
}

/// Where the record of an output is.
fn place(output: &Path) -> PathBuf {
    let mut name = output.file_name().unwrap_or_default().to_owned();
    name.push(".json");
    output.with_file_name(".b2p").join(name)
}

/// The options of this run that decide what is written, the command first.
pub fn options() -> Vec<String> {
    CommandLine::without(std::env::args_os().skip(1), &IRRELEVANT)
        .iter()
        .map(|option| option.to_string_lossy().into_owned())
        .collect()
}
