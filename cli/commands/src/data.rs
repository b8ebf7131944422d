//! Data beside the code that is large and that few runs need: the model of learned streams, and the web page.
//!
//! With the feature `bundled` they are inside the program. Packages leave it out and have them as files, so that the
//! program stays small: in `share/b2p` beside the program, beside the folder that it is in, or in `/usr`.

use std::borrow::Cow;
use std::io::Write;
use std::path::{Path, PathBuf};

use super::{Failure, Result};

/// The environment variable that names the folder of these files, whatever is inside the program.
const FOLDER: &str = "B2P_DATA";
/// The model of learned streams in that folder.
const MODEL: &str = "lite.safetensors";
/// The page in that folder, and its module.
const PAGE: &str = "web";
const MODULE: &str = "b2p.wasm";

/// A learned stream that is coded with [`model`], if there is one.
pub const SAMPLE: Option<&[u8]> = {
    #[cfg(feature = "bundled")]
    let sample = Some(b2p::embedded::SAMPLE);
    #[cfg(not(feature = "bundled"))]
    let sample = None;
    sample
};

/// The model that learned streams are coded with unless another is named, as a safetensors file.
pub fn model() -> Result<Cow<'static, [u8]>> {
    match Source::find()? {
        #[cfg(feature = "bundled")]
        Source::Program => Ok(b2p::embedded::model().into()),
        Source::Folder(folder) => {
            let path = folder.join(MODEL);
            let fail = |error| {
                format!(
                    "{}: {error}; --model FILE names a model of learned colours",
                    path.display()
                )
            };
            Ok(std::fs::read(&path).map_err(|error| Failure(fail(error)))?.into())
        }
    }
}

/// Writes what tells [`model`] from others: the file, or what is inside the program as it is stored.
pub fn identify_model(mut to: impl Write) -> Result<()> {
    let fail = |error: std::io::Error| Failure(error.to_string());
    match Source::find()? {
        #[cfg(feature = "bundled")]
        Source::Program => to.write_all(b2p::embedded::MODEL_ZLIB).map_err(fail),
        Source::Folder(folder) => {
            let mut file = std::fs::File::open(folder.join(MODEL)).map_err(fail)?;
            std::io::copy(&mut file, &mut to).map(|_| ()).map_err(fail)
        }
    }
}

/// A file of the web page.
#[derive(Debug, Clone, Copy)]
pub struct PageFile<'a> {
    pub media_type: &'static str,
    pub bytes: &'a [u8],
    /// Whether they are compressed by gzip.
    pub gzip: bool,
}

/// The files of the web page.
pub enum Page {
    #[cfg(feature = "bundled")]
    Program,
    /// By the names that the page knows, each with its bytes and whether they are compressed.
    Files(Vec<(String, Vec<u8>, bool)>),
}

impl Page {
    /// The page of the folder, or the one inside the program.
    pub fn open() -> Result<Page> {
        match Source::find()? {
            #[cfg(feature = "bundled")]
            Source::Program => {
                if !b2p_web::HAS_MODULE {
                    let text =
                        "this program was built without its web page: run web/build.sh, then build the program again";
                    return Err(Failure(text.into()));
                }
                // Unpacked by the time that a browser asks for it; without this thread, it is when one does.
                let _ = std::thread::Builder::new().spawn(|| b2p_web::module_gzip(MODULE));
                Ok(Page::Program)
            }
            Source::Folder(folder) => Self::read(&folder.join(PAGE)),
        }
    }

    /// All files in `folder` that a browser loads, and in its folder of scripts.
    fn read(folder: &Path) -> Result<Page> {
        let mut files = Vec::new();
        for (inner, prefix) in [(folder.to_owned(), ""), (folder.join("src"), "src/")] {
            let fail = |error| Failure(format!("{}: the web page cannot be read: {error}", inner.display()));
            for entry in std::fs::read_dir(&inner).map_err(fail)? {
                let path = entry.map_err(fail)?.path();
                let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
                let plain = name.strip_suffix(".gz").unwrap_or(name);
                if media_type(plain).is_some() {
                    let bytes = std::fs::read(&path).map_err(fail)?;
                    files.push((format!("{prefix}{plain}"), bytes, plain.len() < name.len()));
                }
            }
        }
        if !files.iter().any(|file| file.0 == MODULE) {
            return Err(Failure(format!("{}: the web page lacks {MODULE}", folder.display())));
        }
        Ok(Page::Files(files))
    }

    /// The file that the page expects there, from its root, without a slash in front.
    pub fn file(&self, path: &str) -> Option<PageFile<'_>> {
        match self {
            #[cfg(feature = "bundled")]
            Page::Program => {
                let plain = b2p_web::FILES.iter().find(|file| file.path == path);
                Some(PageFile {
                    media_type: media_type(path)?,
                    bytes: plain.map(|file| file.bytes).or_else(|| b2p_web::module_gzip(path))?,
                    gzip: plain.is_none(),
                })
            }
            Page::Files(files) => {
                let (_, bytes, gzip) = files.iter().find(|file| file.0 == path)?;
                Some(PageFile {
                    media_type: media_type(path)?,
                    bytes,
                    gzip: *gzip,
                })
            }
        }
    }
}

fn media_type(name: &str) -> Option<&'static str> {
    match name.rsplit_once('.')?.1 {
        "html" => Some("text/html; charset=utf-8"),
        "js" => Some("text/javascript; charset=utf-8"),
        "wasm" => Some("application/wasm"),
        _ => None,
    }
}

/// Where the data are.
enum Source {
    #[cfg(feature = "bundled")]
    Program,
    Folder(PathBuf),
}

impl Source {
    fn find() -> Result<Source> {
        match std::env::var_os(FOLDER) {
            Some(folder) => Ok(Source::Folder(folder.into())),
            None => Self::default(),
        }
    }

    #[cfg(feature = "bundled")]
    fn default() -> Result<Source> {
        Ok(Source::Program)
    }

    /// The first of the folders where packages have the data.
    #[cfg(not(feature = "bundled"))]
    fn default() -> Result<Source> {
        let mut folders = beside_program();
        folders.extend(["/usr/local/share/b2p", "/usr/share/b2p"].map(PathBuf::from));
        if let Some(folder) = folders.iter().find(|folder| folder.is_dir()) {
            return Ok(Source::Folder(folder.clone()));
        }
        let tried: Vec<String> = folders.iter().map(|folder| folder.display().to_string()).collect();
        Err(Failure(format!(
            "the model of learned colours and the web page are files beside this program, but there is no folder {}; \
             {FOLDER} names another one",
            tried.join(" or ")
        )))
    }
}

/// `share/b2p` beside the program and beside the folder that it is in. None where the system does not say where that is.
#[cfg(not(feature = "bundled"))]
fn beside_program() -> Vec<PathBuf> {
    // Without /proc, it is where it was called by a path.
    let called = || {
        std::env::args_os()
            .next()
            .map(PathBuf::from)
            .filter(|path| path.components().count() > 1)
    };
    let program = std::env::current_exe()
        .ok()
        .or_else(called)
        .and_then(|path| path.canonicalize().ok());
    let program = program.unwrap_or_default();
    program
        .ancestors()
        .skip(1)
        .take(2)
        .map(|folder| folder.join("share/b2p"))
        .collect()
}
