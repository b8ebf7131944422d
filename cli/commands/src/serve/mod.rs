//! `b2p serve`: the web page, streams and files of Gaussians by HTTP.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::time::Duration;

use b2p_formats::detect::{ENOUGH, Group, Kind};
use serde_json::json;

use super::args::Serve;
use super::data::Page;
use super::manners::{self, Said};
use super::table::counted;
use super::{Failure, Result};
use http::{Bounds, Request, Response};

mod http;

/// A page and its files take a few connections each.
const BOUNDS: Bounds = Bounds {
    connections: 64,
    request: Duration::from_secs(30),
    stalled: Duration::from_secs(30),
};
/// Bytes of an address.
const LONGEST: usize = 2048;
/// Endings of files of Gaussians, of which those are served that are known by their first bytes.
const SPLATS: [&str; 4] = [".ply", ".spz", ".sog", ".splat"];
/// Where the page finds the learned heads.
const HEADS: &str = "heads.safetensors";

/// Serves until the program is stopped.
pub fn run(args: &Serve) -> Result<Said> {
    let page = Page::open()?;
    let streams = Streams::find(&args.source)?;
    let count = streams.names()?.len();
    let address = SocketAddr::new(args.host, args.port);
    let fail = |error| Failure(format!("cannot listen at {address}: {error}"));
    let listener = TcpListener::bind(address).map_err(fail)?;
    let address = listener.local_addr().map_err(fail)?;
    let shown = format!("http://{address}/");
    let said = match manners::json() {
        true => Said::result(format!("{}\n", json!({ "address": shown, "streams": count }))),
        false => Said::result(format!(
            "{} at {shown}; Ctrl-C ends it\n",
            counted(count as u64, "file")
        )),
    };
    said.say()?;
    http::serve(&listener, BOUNDS, &|request| common(answer(request, &page, &streams)))
}

/// The streams and files of Gaussians that are served.
struct Streams {
    folder: PathBuf,
    /// The only one, if a file was named.
    only: Option<String>,
}

impl Streams {
    fn find(source: &Path) -> Result<Streams> {
        let fail = |error| Failure(format!("{}: {error}", source.display()));
        let source = source.canonicalize().map_err(fail)?;
        if source.is_dir() {
            let streams = Streams {
                folder: source,
                only: None,
            };
            return match streams.names()?.is_empty() {
                true => Err(Failure(format!(
                    "{}: there is no .b2p file in it, and none of Gaussians",
                    streams.folder.display()
                ))),
                false => Ok(streams),
            };
        }
        let name = source.file_name().and_then(|name| name.to_str()).map(str::to_owned);
        let name = name.ok_or_else(|| Failure(format!("{}: its name is not Unicode", source.display())))?;
        Ok(Streams {
            folder: source.parent().unwrap_or(Path::new("/")).to_owned(),
            only: Some(name),
        })
    }

    /// Their names at present, in order.
    fn names(&self) -> Result<Vec<String>> {
        if let Some(name) = &self.only {
            return Ok(vec![name.clone()]);
        }
        let fail = |error| Failure(format!("{}: {error}", self.folder.display()));
        let entries = std::fs::read_dir(&self.folder).map_err(fail)?;
        let names = entries.filter_map(|entry| entry.ok()?.file_name().into_string().ok());
        let mut names: Vec<String> = names.filter(|name| self.is_shown(name)).collect();
        names.sort();
        Ok(names)
    }

    /// Whether a file of the folder is one that the page shows.
    fn is_shown(&self, name: &str) -> bool {
        let is_splats = || -> Option<bool> {
            let mut start = Vec::new();
            let file = self.inside(name)?.take(ENOUGH as u64).read_to_end(&mut start);
            file.ok()?;
            Some(Kind::of(&start).group() == Group::Splats)
        };
        name.ends_with(".b2p") || (SPLATS.iter().any(|ending| name.ends_with(ending)) && is_splats().unwrap_or(false))
    }

    /// A file that is served, by its name. No other file of the folder is.
    fn open(&self, name: &str) -> Option<File> {
        let is_served = match &self.only {
            Some(only) => only == name,
            None => !name.contains(std::path::is_separator) && self.is_shown(name),
        };
        self.inside(name).filter(|_| is_served)
    }

    /// A file of the folder, and none that a link leads to outside of it.
    fn inside(&self, name: &str) -> Option<File> {
        let path = self.folder.join(name).canonicalize().ok()?;
        let inside = path.parent() == Some(&self.folder) && path.is_file();
        inside.then(|| File::open(path).ok()).flatten()
    }
}

/// The answer to a request.
fn answer<'a>(request: &Request, page: &'a Page, streams: &Streams) -> Response<'a> {
    let target = &request.target;
    let path = target.split(['?', '#']).next().unwrap_or_default();
    let path = path.trim_start_matches('/');
    let Some(path) = decoded(path).filter(|_| target.len() <= LONGEST) else {
        return plain(400, "this is no address of a file\n");
    };
    let file = match path.as_str() {
        "" => "index.html",
        path => path,
    };
    if let Some(file) = page.file(file) {
        let response = Response::bytes(file.bytes, file.media_type);
        return match file.gzip {
            true => response.with("Content-Encoding", "gzip"),
            false => response,
        };
    }
    match file {
        HEADS => Response::bytes(b2p::embedded::HEADS, "application/octet-stream"),
        "streams.json" => {
            let names = streams.names().unwrap_or_default();
            let list = json!({ "streams": names, "heads": HEADS }).to_string();
            Response::text(200, list, "application/json")
        }
        name => match streams.open(name) {
            Some(file) => stream(request, file),
            None => plain(404, "no such file\n"),
        },
    }
}

/// A stream, or the range of it that was asked for.
fn stream(request: &Request, mut file: File) -> Response<'static> {
    let Ok(length) = file.metadata().map(|metadata| metadata.len()) else {
        return plain(500, "the file cannot be read\n");
    };
    let (status, range) = match request.range.as_deref().map(|asked| range(asked, length)) {
        None => (200, 0..length),
        Some(Some(range)) => (206, range),
        Some(None) => {
            let all = format!("bytes */{length}");
            return plain(416, "there is no such range\n").with("Content-Range", all);
        }
    };
    if file.seek(SeekFrom::Start(range.start)).is_err() {
        return plain(500, "the file cannot be read\n");
    }
    let response = Response::file(status, file, range.end - range.start).with("Accept-Ranges", "bytes");
    match status {
        206 => {
            let part = format!("bytes {}-{}/{length}", range.start, range.end - 1);
            response.with("Content-Range", part)
        }
        _ => response,
    }
}

/// The bytes that a `Range` header asks for, if it asks for one range that is there.
fn range(value: &str, length: u64) -> Option<std::ops::Range<u64>> {
    let (first, last) = value.trim().strip_prefix("bytes=")?.split_once('-')?;
    let number = |text: &str| text.trim().parse::<u64>().ok();
    let range = match (first.trim(), last.trim()) {
        ("", last) => length.saturating_sub(number(last)?)..length,
        (first, "") => number(first)?..length,
        (first, last) => number(first)?..number(last)?.saturating_add(1).min(length),
    };
    (range.start < range.end).then_some(range)
}

/// A path whose `%` escapes are decoded, if that is one.
fn decoded(path: &str) -> Option<String> {
    let mut bytes = Vec::with_capacity(path.len());
    let mut rest = path.bytes();
    while let Some(byte) = rest.next() {
        bytes.push(match byte {
            b'%' => {
                let mut digit = || char::from(rest.next()?).to_digit(16);
                (16 * digit()? + digit()?) as u8
            }
            byte => byte,
        });
    }
    String::from_utf8(bytes).ok().filter(|path| !path.contains('\0'))
}

fn plain(status: u16, text: &str) -> Response<'static> {
    Response::text(status, text.to_owned(), "text/plain; charset=utf-8")
}

/// What every answer says: that other sites get nothing, that the page may use threads, and that files may change.
fn common(response: Response<'_>) -> Response<'_> {
    [
        ("Cross-Origin-Opener-Policy", "same-origin"),
        ("Cross-Origin-Embedder-Policy", "require-corp"),
        ("Cross-Origin-Resource-Policy", "same-origin"),
        ("X-Content-Type-Options", "nosniff"),
        ("Cache-Control", "no-cache"),
    ]
    .into_iter()
    .fold(response, |response, (name, value)| response.with(name, value))
}

#[cfg(test)]
mod tests {
    use super::{decoded, range};

    #[test]
    fn ranges_are_those_of_http() {
        assert_eq!(range("bytes=0-9", 100), Some(0..10));
        assert_eq!(range("bytes=90-", 100), Some(90..100));
        assert_eq!(range("bytes=-10", 100), Some(90..100));
        assert_eq!(range("bytes=0-1000", 100), Some(0..100));
        for none in [
            "bytes=100-",
            "bytes=5-4",
            "bytes=-0",
            "bytes=0-9,20-29",
            "lines=0-9",
            "bytes=a-b",
        ] {
            assert_eq!(range(none, 100), None, "{none}");
        }
        assert_eq!(range("bytes=0-18446744073709551615", 100), Some(0..100));
    }

    #[test]
    fn escapes_are_decoded_and_broken_ones_refused() {
        assert_eq!(decoded("a%20b.b2p").as_deref(), Some("a b.b2p"));
        for broken in ["%", "%2", "%zz", "%ff", "a%00"] {
            assert_eq!(decoded(broken), None, "{broken}");
        }
    }
}
