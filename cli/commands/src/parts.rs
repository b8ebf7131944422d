//! Gaussians that go to a file as they are made, so that no more of them are in memory than a part.

use std::fs::File;
use std::io::{self, BufWriter, Read, Seek, Write};
use std::path::Path;
use std::time::{Duration, Instant};

use b2p::gaussians::Gaussians;
use b2p::log::Log;
use b2p::output::Temporary;
use b2p::{Decoding, Error};
use b2p_formats::splats::PartWriter;

use super::{Failure, Result, manners};

/// Writes the Gaussians of the level that was decoded from `input`, as a step of this name. Returns how many there are,
/// and warnings.
pub fn write(
    level: &Decoding<'_>,
    input: &Path,
    writer: PartWriter,
    to: &Path,
    (name, log): (String, &Log),
) -> Result<(usize, Vec<String>)> {
    let start = Instant::now();
    let fail = Failure::in_file(input);
    let count = level.gaussian_count().map_err(&fail)?;
    let mut parts = Parts::new(writer, count, to)?;
    let (mut drawing, mut failed) = (Duration::ZERO, None);
    let written = manners::write(to, |out| {
        let begun = Instant::now();
        let drawn = level.gaussians_in_parts(|part| parts.add(part, out));
        drawing = begun.elapsed().saturating_sub(parts.time);
        match drawn {
            Ok(()) => parts.finish(out),
            // It has a name already.
            Err(error @ Error::Io { .. }) => Err(error),
            Err(error) => {
                failed = Some(fail(error));
                Err(Error::Cancelled)
            }
        }
    });
    match failed {
        Some(failed) => return Err(failed),
        None => written?,
    }
    log.add(
        name,
        parts.written,
        "Gaussians",
        start.elapsed().saturating_sub(drawing),
    );
    Ok((parts.written, parts.writer.warnings()))
}

/// A file on its way.
struct Parts<'a> {
    writer: PartWriter,
    to: &'a Path,
    /// What there will be, if that is known.
    count: Option<usize>,
    /// A Gaussian-less part, once there was a part.
    like: Option<Gaussians>,
    /// Where rows wait until it is known how many they are.
    waiting: Option<Waiting>,
    written: usize,
    /// What writing took.
    time: Duration,
}

impl<'a> Parts<'a> {
    fn new(writer: PartWriter, count: Option<usize>, to: &'a Path) -> Result<Self> {
        let waits = writer.has_count() && count.is_none();
        Ok(Parts {
            waiting: waits.then(|| Waiting::beside(to)).transpose()?,
            writer,
            to,
            count,
            like: None,
            written: 0,
            time: Duration::ZERO,
        })
    }

    /// Writes a part to `out`, or to where it waits.
    fn add(&mut self, part: &Gaussians, out: &mut dyn Write) -> b2p::Result<()> {
        let start = Instant::now();
        if self.like.is_none() {
            self.like = Some(Gaussians {
                frame: part.frame,
                blur: part.blur,
                compensated: part.compensated,
                ..Gaussians::default()
            });
            if self.waiting.is_none() {
                self.write_head(self.count.unwrap_or(0), out)?;
            }
        }
        let out = match &mut self.waiting {
            Some(waiting) => &mut waiting.file,
            None => out,
        };
        self.writer.write_rows(part, out, self.to)?;
        self.written += part.len();
        self.time += start.elapsed();
        Ok(())
    }

    fn write_head(&self, count: usize, out: &mut dyn Write) -> b2p::Result<()> {
        let like = self.like.clone().unwrap_or_default();
        let head = self.writer.head(&like, count)?;
        out.write_all(&head).map_err(|source| self.failed(source))
    }

    /// Writes what waits.
    fn finish(&mut self, out: &mut dyn Write) -> b2p::Result<()> {
        let Some(waiting) = self.waiting.take() else {
            return Ok(());
        };
        self.write_head(self.written, out)?;
        waiting.copy_to(out).map_err(|source| self.failed(source))
    }

    fn failed(&self, source: io::Error) -> Error {
        Error::Io {
            path: self.to.to_owned(),
            source,
        }
    }
}

/// Rows in a temporary file.
struct Waiting {
    file: BufWriter<File>,
    /// Removed in the end.
    _temporary: Temporary,
}

impl Waiting {
    /// An empty file in the folder of `to`, or, if that is no regular file, in the one for temporary files.
    fn beside(to: &Path) -> Result<Self> {
        let is_other = std::fs::metadata(to).is_ok_and(|found| !found.is_file());
        let folder = match to.parent() {
            _ if is_other || manners::is_pipe(to) => std::env::temp_dir(),
            Some(folder) if folder != Path::new("") => folder.to_owned(),
            _ => ".".into(),
        };
        let create = || {
            let temporary = Temporary::in_folder(&folder, "rows".as_ref())?;
            let file = File::options().read(true).write(true).open(temporary.path())?;
            let file = BufWriter::with_capacity(1 << 16, file);
            io::Result::Ok(Waiting {
                file,
                _temporary: temporary,
            })
        };
        create().map_err(|source| Failure::writing(&folder, source))
    }

    fn copy_to(mut self, out: &mut dyn Write) -> io::Result<()> {
        self.file.rewind()?;
        let file = self.file.get_mut();
        let mut bytes = vec![0; 1 << 16];
        loop {
            match file.read(&mut bytes)? {
                0 => return Ok(()),
                count => out.write_all(&bytes[..count])?,
            }
        }
    }
}
