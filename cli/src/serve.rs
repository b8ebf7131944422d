//! `b2p serve`: the web page and streams by HTTP.

use std::fs::File;
use std::io::{Cursor, Read, Seek, SeekFrom};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use serde_json::json;
use tiny_http::{Header, Method, Request, Response, Server, StatusCode};

use super::args::Serve;
use super::manners::{self, Said};
use super::table::counted;
use super::{Failure, Result};

/// Requests that are answered at the same time; others wait.
const THREADS: usize = 8;
/// Bytes of an address.
const LONGEST: usize = 2048;
/// Where the page finds the learned heads.
const HEADS: &str = "heads.safetensors";

/// Serves until the program is stopped.
pub fn run(args: &Serve) -> Result<Said> {
    let Some(module) = b2p_web::MODULE_GZIP else {
        let text = "this program was built without its web page: run web/build.sh, then build the program again";
        return Err(Failure(text.into()));
    };
    let streams = Streams::find(&args.source)?;
    let count = streams.names()?.len();
    let address = SocketAddr::new(args.host, args.port);
    let server = Server::http(address).map_err(|error| Failure(format!("cannot listen at {address}: {error}")))?;
    let address = server.server_addr().to_ip().unwrap_or(address);
    let shown = format!("http://{address}/");
    let said = match manners::json() {
        true => Said::result(format!("{}\n", json!({ "address": shown, "streams": count }))),
        false => Said::result(format!(
            "{} at {shown}; Ctrl-C ends it\n",
            counted(count as u64, "stream")
        )),
    };
    said.say()?;
    std::thread::scope(|scope| {
        for _ in 0..THREADS {
            scope.spawn(|| {
                while let Ok(request) = server.recv() {
                    answer(request, &streams, module);
                }
            });
        }
    });
    Ok(Said::default())
}

/// The streams that are served.
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
                    "{}: there is no .b2p file in it",
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
        let mut names: Vec<String> = names.filter(|name| name.ends_with(".b2p")).collect();
        names.sort();
        Ok(names)
    }

    /// A stream by its name. No other file of the folder is served, and none that a link leads to outside of it.
    fn open(&self, name: &str) -> Option<File> {
        if !self.names().ok()?.iter().any(|known| known == name) {
            return None;
        }
        let path = self.folder.join(name).canonicalize().ok()?;
        let inside = path.parent() == Some(&self.folder) && path.is_file();
        inside.then(|| File::open(path).ok()).flatten()
    }
}

/// Answers a request. What fails is the connection, which has then nobody at its other end.
fn answer(request: Request, streams: &Streams, module: &'static [u8]) {
    if !matches!(request.method(), Method::Get | Method::Head) {
        let _ = request.respond(plain(405, "only GET and HEAD\n").with_header(header("Allow", "GET, HEAD")));
        return;
    }
    let url = request.url();
    let path = url.split(['?', '#']).next().unwrap_or_default().trim_start_matches('/');
    let Some(path) = decoded(path).filter(|_| url.len() <= LONGEST) else {
        let _ = request.respond(plain(400, "this is no address of a file\n"));
        return;
    };
    let file = match path.as_str() {
        "" => "index.html",
        path => path,
    };
    if let Some(page) = b2p_web::FILES.iter().find(|page| page.path == file) {
        let _ = request.respond(bytes(page.bytes, page.media_type));
        return;
    }
    match file {
        "b2p.wasm" => {
            let response = bytes(module, "application/wasm").with_header(header("Content-Encoding", "gzip"));
            let _ = request.respond(response);
        }
        HEADS => {
            let _ = request.respond(bytes(b2p::embedded::HEADS, "application/octet-stream"));
        }
        "streams.json" => {
            let names = streams.names().unwrap_or_default();
            let list = json!({ "streams": names, "heads": HEADS }).to_string();
            let response = Response::from_data(list).with_header(header("Content-Type", "application/json"));
            let _ = request.respond(common(response));
        }
        name => match streams.open(name) {
            Some(file) => stream(request, file),
            None => {
                let _ = request.respond(plain(404, "no such file\n"));
            }
        },
    }
}

/// Answers with a stream, or with the range of it that was asked for.
fn stream(request: Request, mut file: File) {
    let Ok(length) = file.metadata().map(|metadata| metadata.len()) else {
        let _ = request.respond(plain(500, "the file cannot be read\n"));
        return;
    };
    let asked = request.headers().iter().find(|header| header.field.equiv("Range"));
    let range = asked.map(|header| range(header.value.as_str(), length));
    let (status, range) = match range {
        None => (200, 0..length),
        Some(Some(range)) => (206, range),
        Some(None) => {
            let all = header("Content-Range", &format!("bytes */{length}"));
            let _ = request.respond(plain(416, "there is no such range\n").with_header(all));
            return;
        }
    };
    if file.seek(SeekFrom::Start(range.start)).is_err() {
        let _ = request.respond(plain(500, "the file cannot be read\n"));
        return;
    }
    let count = range.end - range.start;
    let body = file.take(count);
    let mut headers = vec![
        header("Content-Type", "application/octet-stream"),
        header("Accept-Ranges", "bytes"),
    ];
    if status == 206 {
        let part = format!("bytes {}-{}/{length}", range.start, range.end - 1);
        headers.push(header("Content-Range", &part));
    }
    let response = Response::new(StatusCode(status), headers, body, usize::try_from(count).ok(), None);
    let _ = request.respond(common(response));
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

fn bytes(bytes: &'static [u8], media_type: &str) -> Response<Cursor<&'static [u8]>> {
    let headers = vec![header("Content-Type", media_type)];
    let body = Cursor::new(bytes);
    common(Response::new(StatusCode(200), headers, body, Some(bytes.len()), None))
}

fn plain(status: u16, text: &str) -> Response<Cursor<Vec<u8>>> {
    common(Response::from_string(text).with_status_code(status))
}

/// What every answer says: how long it is, that other sites get nothing, that the page may use threads, and that files
/// may change.
fn common<R: Read>(response: Response<R>) -> Response<R> {
    [
        ("Cross-Origin-Opener-Policy", "same-origin"),
        ("Cross-Origin-Embedder-Policy", "require-corp"),
        ("Cross-Origin-Resource-Policy", "same-origin"),
        ("X-Content-Type-Options", "nosniff"),
        ("Cache-Control", "no-cache"),
    ]
    .into_iter()
    .fold(
        response.with_chunked_threshold(usize::MAX),
        |response, (name, value)| response.with_header(header(name, value)),
    )
}

fn header(name: &str, value: &str) -> Header {
    Header::from_bytes(name, value).expect("names and values here are ASCII")
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
