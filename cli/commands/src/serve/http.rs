//! A small HTTP/1.1 server: GET and HEAD, a bounded number of connections, each with bounded heads and times.

use std::fs::File;
use std::io::{ErrorKind, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

/// Bytes of a request.
const HEAD: usize = 1 << 14;
/// Header fields of a request.
const FIELDS: usize = 64;
/// Bytes of a file that are sent at once.
const PIECE: usize = 1 << 16;
/// How long nothing is accepted after accepting failed: for want of file descriptors, for example.
const PAUSE: Duration = Duration::from_millis(50);

/// What connections may take.
#[derive(Debug, Clone, Copy)]
pub struct Bounds {
    /// Connections that are open at the same time. What comes beyond is answered with status 503.
    pub connections: usize,
    /// Time from one answer, or from the connection, to the end of the next request.
    pub request: Duration,
    /// Time in which the other end takes some bytes of an answer.
    pub stalled: Duration,
}

/// A request for a file.
#[derive(Debug)]
pub struct Request {
    /// Path and query, as they were sent.
    pub target: String,
    /// The field `Range`.
    pub range: Option<String>,
}

/// What is sent back.
#[derive(Debug)]
pub struct Response<'a> {
    status: u16,
    fields: Vec<(&'static str, String)>,
    body: Body<'a>,
}

#[derive(Debug)]
enum Body<'a> {
    Bytes(&'a [u8]),
    Owned(Vec<u8>),
    /// So many bytes from where the file stands.
    File(File, u64),
}

impl<'a> Response<'a> {
    /// Bytes of this media type.
    pub fn bytes(bytes: &'a [u8], media_type: &str) -> Self {
        Self::new(200, Body::Bytes(bytes)).with("Content-Type", media_type)
    }

    /// The next `length` bytes of a file.
    pub fn file(status: u16, file: File, length: u64) -> Self {
        Self::new(status, Body::File(file, length)).with("Content-Type", "application/octet-stream")
    }

    /// A text.
    pub fn text(status: u16, text: String, media_type: &str) -> Self {
        Self::new(status, Body::Owned(text.into_bytes())).with("Content-Type", media_type)
    }

    fn new(status: u16, body: Body<'a>) -> Self {
        Response {
            status,
            fields: Vec::new(),
            body,
        }
    }

    /// The same with another header field.
    pub fn with(mut self, name: &'static str, value: impl Into<String>) -> Self {
        self.fields.push((name, value.into()));
        self
    }

    fn length(&self) -> u64 {
        match &self.body {
            Body::Bytes(bytes) => bytes.len() as u64,
            Body::Owned(bytes) => bytes.len() as u64,
            Body::File(_, length) => *length,
        }
    }

    /// Sends it. `head`: without its body.
    fn send(self, to: &mut TcpStream, head: bool, keep: bool) -> std::io::Result<()> {
        let mut text = format!("HTTP/1.1 {} {}\r\n", self.status, reason(self.status));
        for (name, value) in &self.fields {
            text += &format!("{name}: {value}\r\n");
        }
        let connection = if keep { "keep-alive" } else { "close" };
        text += &format!("Content-Length: {}\r\nConnection: {connection}\r\n\r\n", self.length());
        to.write_all(text.as_bytes())?;
        match self.body {
            _ if head => Ok(()),
            Body::Bytes(bytes) => to.write_all(bytes),
            Body::Owned(bytes) => to.write_all(&bytes),
            Body::File(file, length) => send_file(file, length, to),
        }
    }
}

/// Sends bytes of a file. Fails if it has become shorter, since a length was promised.
fn send_file(file: File, length: u64, to: &mut TcpStream) -> std::io::Result<()> {
    let mut left = file.take(length);
    let mut piece = vec![0; PIECE];
    while left.limit() > 0 {
        match left.read(&mut piece)? {
            0 => return Err(ErrorKind::UnexpectedEof.into()),
            n => to.write_all(&piece[..n])?,
        }
    }
    Ok(())
}

fn reason(status: u16) -> &'static str {
    match status {
        200 => "OK",
        206 => "Partial Content",
        400 => "Bad Request",
        404 => "Not Found",
        405 => "Method Not Allowed",
        408 => "Request Timeout",
        416 => "Range Not Satisfiable",
        431 => "Request Header Fields Too Large",
        503 => "Service Unavailable",
        _ => "Internal Server Error",
    }
}

/// Answers all that connects, each connection in a thread of its own, without end.
pub fn serve<'a>(listener: &TcpListener, bounds: Bounds, answer: &(impl Fn(&Request) -> Response<'a> + Sync)) -> ! {
    let open = AtomicUsize::new(0);
    std::thread::scope(|scope| {
        loop {
            let Ok((mut stream, _)) = listener.accept() else {
                std::thread::sleep(PAUSE);
                continue;
            };
            if open.load(Ordering::Acquire) >= bounds.connections {
                refuse(stream);
                continue;
            }
            open.fetch_add(1, Ordering::AcqRel);
            let open = &open;
            let connection = move || {
                // What fails is the connection, which has nobody at its other end then.
                let _ = converse(&mut stream, bounds, answer);
                // Before it is closed: whoever sees that may connect again.
                open.fetch_sub(1, Ordering::AcqRel);
            };
            if std::thread::Builder::new().spawn_scoped(scope, connection).is_err() {
                open.fetch_sub(1, Ordering::AcqRel);
            }
        }
    })
}

/// Says that there are too many connections.
fn refuse(mut stream: TcpStream) {
    // It fits into the buffer of any socket: nothing waits.
    let _ = stream.set_nonblocking(true);
    let response = Response::text(503, "too many connections\n".into(), "text/plain").with("Retry-After", "1");
    let _ = response.send(&mut stream, false, false);
}

/// Answers the requests of a connection, one after the other.
fn converse<'a>(
    stream: &mut TcpStream,
    bounds: Bounds,
    answer: &impl Fn(&Request) -> Response<'a>,
) -> std::io::Result<()> {
    stream.set_write_timeout(Some(bounds.stalled))?;
    stream.set_nodelay(true)?;
    // What was read after a request belongs to the next one.
    let mut bytes = Vec::new();
    loop {
        let Some(asked) = next(stream, &mut bytes, bounds.request)? else {
            return Ok(());
        };
        match asked {
            Asked::File { request, head, keep } => {
                answer(&request).send(stream, head, keep)?;
                if !keep {
                    return Ok(());
                }
            }
            Asked::Refused(response) => return response.send(stream, false, false),
        }
    }
}

/// What was asked for.
enum Asked {
    File { request: Request, head: bool, keep: bool },
    Refused(Response<'static>),
}

/// Reads the next request, and leaves in `bytes` what follows it. `None` if the other end has closed, or sends nothing.
fn next(stream: &mut TcpStream, bytes: &mut Vec<u8>, time: Duration) -> std::io::Result<Option<Asked>> {
    let refused = |status, text: &str| Ok(Some(Asked::Refused(Response::text(status, text.into(), "text/plain"))));
    let end = Instant::now() + time;
    loop {
        match parsed(bytes) {
            Parsed::Whole(length, asked) => {
                bytes.drain(..length);
                return Ok(Some(asked));
            }
            Parsed::Broken => return refused(400, "this is no request\n"),
            Parsed::Part if bytes.len() >= HEAD => return refused(431, "the request is too long\n"),
            Parsed::Part => {}
        }
        let left = end.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return match bytes.is_empty() {
                true => Ok(None),
                false => refused(408, "the request takes too long\n"),
            };
        }
        stream.set_read_timeout(Some(left))?;
        let mut piece = [0; 1 << 12];
        let room = piece.len().min(HEAD - bytes.len());
        match stream.read(&mut piece[..room]) {
            Ok(0) => return Ok(None),
            Ok(n) => bytes.extend(&piece[..n]),
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {}
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
}

enum Parsed {
    /// A request of so many bytes.
    Whole(usize, Asked),
    Part,
    Broken,
}

fn parsed(bytes: &[u8]) -> Parsed {
    let mut fields = [httparse::EMPTY_HEADER; FIELDS];
    let mut request = httparse::Request::new(&mut fields);
    let length = match request.parse(bytes) {
        Ok(httparse::Status::Complete(length)) => length,
        Ok(httparse::Status::Partial) => return Parsed::Part,
        Err(_) => return Parsed::Broken,
    };
    let (Some(method), Some(target)) = (request.method, request.path) else {
        return Parsed::Broken;
    };
    let field = |name: &str| {
        let mut all = request.headers.iter();
        let found = all.find(|field| field.name.eq_ignore_ascii_case(name))?;
        Some(String::from_utf8_lossy(found.value).trim().to_owned())
    };
    if !matches!(method, "GET" | "HEAD") {
        let response = Response::text(405, "only GET and HEAD\n".into(), "text/plain").with("Allow", "GET, HEAD");
        return Parsed::Whole(length, Asked::Refused(response));
    }
    let connection = field("Connection").unwrap_or_default().to_ascii_lowercase();
    // What a body would be is not read: the connection ends.
    let has_body = field("Transfer-Encoding").is_some() || field("Content-Length").is_some_and(|length| length != "0");
    let keep = match request.version {
        Some(1) => connection != "close",
        _ => connection == "keep-alive",
    };
    Parsed::Whole(
        length,
        Asked::File {
            request: Request {
                target: target.to_owned(),
                range: field("Range"),
            },
            head: method == "HEAD",
            keep: keep && !has_body,
        },
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A server with two connections at most, whose answer is the target of the request.
    fn start() -> std::net::SocketAddr {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let bounds = Bounds {
            connections: 2,
            request: Duration::from_millis(400),
            stalled: Duration::from_secs(5),
        };
        std::thread::spawn(move || {
            serve(&listener, bounds, &|request| {
                Response::text(200, request.target.clone(), "text/plain")
            })
        });
        address
    }

    fn connect(address: std::net::SocketAddr) -> TcpStream {
        let stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        stream
    }

    /// All that comes back for these bytes.
    fn ask(address: std::net::SocketAddr, request: &str) -> String {
        let mut stream = connect(address);
        let _ = stream.write_all(request.as_bytes());
        let mut all = String::new();
        let _ = stream.read_to_string(&mut all);
        all
    }

    #[test]
    fn requests_of_one_connection_are_answered_in_order() {
        let requests = "GET /a HTTP/1.1\r\n\r\nHEAD /b HTTP/1.1\r\n\r\nGET /c HTTP/1.1\r\nConnection: close\r\n\r\n";
        let all = ask(start(), requests);
        let answers: Vec<&str> = all.split("HTTP/1.1 200 OK\r\n").collect();
        assert_eq!(answers.len(), 4, "{all}");
        assert!(answers[1].ends_with("\r\n\r\n/a") && answers[3].ends_with("\r\n\r\n/c"));
        assert!(answers[2].contains("Content-Length: 2") && answers[2].ends_with("\r\n\r\n"));
    }

    #[test]
    fn connections_beyond_the_bound_are_refused_until_one_ends() {
        let address = start();
        let held = [connect(address), connect(address)];
        let refused = ask(address, "GET / HTTP/1.1\r\nConnection: close\r\n\r\n");
        assert!(refused.starts_with("HTTP/1.1 503 "), "{refused}");
        drop(held);
        let end = Instant::now() + Duration::from_secs(20);
        while !ask(address, "GET / HTTP/1.1\r\nConnection: close\r\n\r\n").starts_with("HTTP/1.1 200 ") {
            assert!(Instant::now() < end, "a connection that ended makes room for another");
        }
    }

    #[test]
    fn what_says_nothing_is_closed_and_what_is_slow_long_or_no_request_is_refused() {
        let address = start();
        assert_eq!(ask(address, ""), "");
        let long = format!("GET / HTTP/1.1\r\nLong: {}", "x".repeat(HEAD));
        for (request, status) in [
            ("GET / HTTP/1.1\r\nSlow", 408),
            ("\0\r\n\r\n", 400),
            (&long[..HEAD], 431),
            ("PUT / HTTP/1.1\r\n\r\n", 405),
        ] {
            let answer = ask(address, request);
            assert!(answer.starts_with(&format!("HTTP/1.1 {status} ")), "{status}: {answer}");
        }
    }
}
