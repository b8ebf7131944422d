//! Videos, of one turn (`--turntable`) or of a sequence: by FFmpeg, as an animated GIF, PNG or WebP, or as YUV4MPEG2.

use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};

use b2p::renderer::Image;
use b2p::{Error, output};

use super::{Failure, Result};

/// Hundredths of a second of a GIF's frame at least: viewers slow down what is shorter.
const LEAST_GIF_DELAY: u64 = 2;

/// Bytes a pixel that a frame takes beside its picture: the frame before, and two copies in eight bits.
pub const BYTES_PER_PIXEL: u64 = 16 + 2 * 4;

/// How long a frame is shown: `duration / timescale` seconds.
#[derive(Debug, Clone, Copy)]
pub struct FrameTime {
    pub timescale: u32,
    pub duration: u32,
}

impl FrameTime {
    /// 30 frames a second.
    pub const THIRTIETH: FrameTime = FrameTime {
        timescale: 30,
        duration: 1,
    };

    /// Units, of which a second has `units`, that frame `i` is shown. The sum over frames is right to half a unit.
    fn shown(self, i: u32, units: u64) -> u64 {
        let start = |i: u64| (2 * units * i * u64::from(self.duration) / u64::from(self.timescale)).div_ceil(2);
        start(u64::from(i) + 1) - start(u64::from(i))
    }
}

/// Kinds of videos.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    Gif,
    Png,
    WebP,
    Y4m,
    /// By FFmpeg.
    Other,
}

/// The kind that a file's ending tells.
pub fn kind_of(path: &Path) -> Result<Kind> {
    let ending = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    match ending.as_str() {
        "gif" => Ok(Kind::Gif),
        "png" | "apng" => Ok(Kind::Png),
        "webp" => Ok(Kind::WebP),
        "y4m" => Ok(Kind::Y4m),
        "mp4" | "webm" | "mkv" | "mov" => Ok(Kind::Other),
        _ => Err(Failure(format!(
            "{}: no videos are written as .{ending}, but as .gif, .webp, .png, .y4m, and with FFmpeg as .mp4, .webm, .mkv and .mov",
            path.display()
        ))),
    }
}

/// Writes the `count` frames that `draw` makes, one after the other, to a file.
pub fn write(
    path: &Path,
    count: u32,
    time: FrameTime,
    mut draw: impl FnMut(u32, &mut Image) -> b2p::Result<()>,
) -> Result<()> {
    let kind = kind_of(path)?;
    if kind == Kind::Other {
        return by_ffmpeg(path, count, time, draw);
    }
    let mut image = Image::default();
    Ok(output::write_file(path, |w| {
        let mut film = Film::new(kind, path, w, time);
        for i in 0..count {
            draw(i, &mut image)?;
            film.add(i, count, &image)?;
        }
        film.finish()
    })?)
}

/// A file that frames are added to.
struct Film<'w> {
    file: File<'w>,
    time: FrameTime,
}

enum File<'w> {
    Gif(
        &'w Path,
        Option<gif::Encoder<&'w mut dyn Write>>,
        Option<&'w mut dyn Write>,
    ),
    Png(
        &'w Path,
        Option<png::Writer<&'w mut dyn Write>>,
        Option<&'w mut dyn Write>,
    ),
    WebP(&'w Path, WebP, &'w mut dyn Write),
    Y4m(&'w Path, &'w mut dyn Write),
}

impl<'w> Film<'w> {
    fn new(kind: Kind, path: &'w Path, to: &'w mut dyn Write, time: FrameTime) -> Self {
        let file = match kind {
            Kind::Gif => File::Gif(path, None, Some(to)),
            Kind::Png => File::Png(path, None, Some(to)),
            Kind::WebP => File::WebP(path, WebP::default(), to),
            Kind::Y4m | Kind::Other => File::Y4m(path, to),
        };
        Film { file, time }
    }

    fn add(&mut self, i: u32, count: u32, image: &Image) -> b2p::Result<()> {
        let time = self.time;
        match &mut self.file {
            File::Gif(path, encoder, to) => {
                let failed = |e: gif::EncodingError| unwritten(path, e);
                let [width, height] = sides(path, image)?;
                if let Some(to) = to.take() {
                    let mut started = gif::Encoder::new(to, width, height, &[]).map_err(failed)?;
                    started.set_repeat(gif::Repeat::Infinite).map_err(failed)?;
                    *encoder = Some(started);
                }
                let mut pixels = straight(image)?;
                let mut frame = gif::Frame::from_rgba_speed(width, height, &mut pixels, 10);
                frame.delay = time.shown(i, 100).clamp(LEAST_GIF_DELAY, u16::MAX.into()) as u16;
                frame.dispose = gif::DisposalMethod::Background;
                match encoder {
                    Some(encoder) => encoder.write_frame(&frame).map_err(failed),
                    None => Ok(()),
                }
            }
            File::Png(path, encoder, to) => {
                let failed = |e: png::EncodingError| unwritten(path, e);
                if let Some(to) = to.take() {
                    let mut started = png::Encoder::new(to, image.width, image.height);
                    started.set_color(png::ColorType::Rgba);
                    started.set_depth(png::BitDepth::Eight);
                    started.set_animated(count, 0).map_err(failed)?;
                    let [part, whole] = match (u16::try_from(time.duration), u16::try_from(time.timescale)) {
                        (Ok(part), Ok(whole)) => [part, whole],
                        _ => [time.shown(0, 1000).min(u16::MAX.into()) as u16, 1000],
                    };
                    started.set_frame_delay(part, whole).map_err(failed)?;
                    *encoder = Some(started.write_header().map_err(failed)?);
                }
                let pixels = straight(image)?;
                match encoder {
                    Some(encoder) => encoder.write_image_data(&pixels).map_err(failed),
                    None => Ok(()),
                }
            }
            File::WebP(path, webp, _) => webp.add(path, time.shown(i, 1000) as u32, image),
            File::Y4m(path, to) => {
                if i == 0 {
                    to.write_all(&y4m_header(image, time)).map_err(|e| unwritten(path, e))?;
                }
                image.write_y4m_frame(to, path)
            }
        }
    }

    fn finish(self) -> b2p::Result<()> {
        match self.file {
            File::Y4m(..) => Ok(()),
            File::Gif(path, encoder, _) => match encoder {
                // Ends the file.
                Some(encoder) => encoder.into_inner().map(drop).map_err(|e| unwritten(path, e)),
                None => Ok(()),
            },
            File::Png(path, encoder, _) => match encoder {
                Some(encoder) => encoder.finish().map_err(|e| unwritten(path, e)),
                None => Ok(()),
            },
            File::WebP(path, webp, to) => webp.write(path, to),
        }
    }
}

/// An animated WebP file (RFC 9649): lossless frames in a container.
#[derive(Default)]
struct WebP {
    size: [u32; 2],
    frames: Vec<u8>,
}

impl WebP {
    fn add(&mut self, path: &Path, milliseconds: u32, image: &Image) -> b2p::Result<()> {
        sides(path, image)?;
        self.size = [image.width, image.height];
        let mut still = Vec::new();
        let encoder = image_webp::WebPEncoder::new(&mut still);
        encoder
            .encode(
                &straight(image)?,
                image.width,
                image.height,
                image_webp::ColorType::Rgba8,
            )
            .map_err(|e| unwritten(path, e))?;
        // After `RIFF`, a length and `WEBP`, a simple file is one chunk: the frame's data.
        let chunk = still.get(12..).unwrap_or_default();
        let mut frame = Vec::new();
        // No offset; sides less one; milliseconds.
        let milliseconds = milliseconds.min((1 << 24) - 1);
        for number in [0, 0, image.width - 1, image.height - 1, milliseconds] {
            frame.extend(&number.to_le_bytes()[..3]);
        }
        // Does not blend with the frame before.
        frame.push(2);
        frame.extend(chunk);
        self.chunk(b"ANMF", &frame);
        Ok(())
    }

    fn chunk(&mut self, name: &[u8; 4], bytes: &[u8]) {
        append(&mut self.frames, name, bytes);
    }

    fn write(self, path: &Path, to: &mut dyn Write) -> b2p::Result<()> {
        let [width, height] = self.size;
        let mut file = b"WEBP".to_vec();
        // Animation and alpha.
        let mut head = vec![0x12, 0, 0, 0];
        for number in [width.max(1) - 1, height.max(1) - 1] {
            head.extend(&number.to_le_bytes()[..3]);
        }
        append(&mut file, b"VP8X", &head);
        // A transparent background, shown for ever.
        append(&mut file, b"ANIM", &[0; 6]);
        let length = (file.len() + self.frames.len()) as u64;
        let length = u32::try_from(length).map_err(|_| unwritten(path, "4 GiB are too much for a WebP file"))?;
        let parts: [&[u8]; 4] = [b"RIFF", &length.to_le_bytes(), &file, &self.frames];
        for part in parts {
            to.write_all(part).map_err(|e| unwritten(path, e))?;
        }
        Ok(())
    }
}

/// Appends a RIFF chunk.
fn append(to: &mut Vec<u8>, name: &[u8; 4], bytes: &[u8]) {
    to.extend(name);
    to.extend((bytes.len() as u32).to_le_bytes());
    to.extend(bytes);
    if bytes.len() % 2 == 1 {
        to.push(0);
    }
}

/// Pipes frames through FFmpeg into a file that appears when it is complete.
fn by_ffmpeg(
    path: &Path,
    count: u32,
    time: FrameTime,
    mut draw: impl FnMut(u32, &mut Image) -> b2p::Result<()>,
) -> Result<()> {
    let folder = match path.parent() {
        Some(folder) if folder != Path::new("") => folder,
        _ => Path::new("."),
    };
    let ending = path.extension().unwrap_or_default();
    let temporary = output::Temporary::in_folder(folder, ending).map_err(|source| Failure::writing(path, source))?;
    let even = "pad=ceil(iw/2)*2:ceil(ih/2)*2:color=white,format=yuv420p";
    let started = Command::new("ffmpeg")
        .args([
            "-nostdin",
            "-loglevel",
            "error",
            "-y",
            "-f",
            "yuv4mpegpipe",
            "-i",
            "-",
            "-vf",
            even,
        ])
        .arg(temporary.path())
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .spawn();
    let mut child = started.map_err(|e| match e.kind() {
        std::io::ErrorKind::NotFound => Failure(format!(
            "{}: FFmpeg is needed for that and is not installed; .gif, .webp and .png are written without it",
            path.display()
        )),
        _ => Failure(format!("ffmpeg: {e}")),
    })?;
    let mut image = Image::default();
    let mut drawn = Ok(());
    if let Some(mut pipe) = child.stdin.take() {
        for i in 0..count {
            drawn = draw(i, &mut image).and_then(|()| {
                if i == 0 {
                    pipe.write_all(&y4m_header(&image, time))
                        .map_err(|e| unwritten(path, e))?;
                }
                image.write_y4m_frame(&mut pipe, path)
            });
            if drawn.is_err() {
                break;
            }
        }
    }
    let ended = child.wait().map_err(|e| Failure(format!("ffmpeg: {e}")))?;
    drawn?;
    if !ended.success() {
        return Err(Failure(format!("{}: ffmpeg failed with {ended}", path.display())));
    }
    temporary.keep_as(path).map_err(|source| Failure::writing(path, source))
}

/// The header of a YUV4MPEG2 file of such pictures.
fn y4m_header(image: &Image, time: FrameTime) -> Vec<u8> {
    let rate = format!(" F{}:{} ", time.timescale, time.duration);
    let header = String::from_utf8_lossy(&image.y4m_header()).replace(" F30:1 ", &rate);
    header.into_bytes()
}

/// Eight bits a channel, straight alpha.
fn straight(image: &Image) -> b2p::Result<Vec<u8>> {
    Ok(image.to_pixmap()?.take_demultiplied())
}

/// Width and height, if the format has so many pixels.
fn sides(path: &Path, image: &Image) -> b2p::Result<[u16; 2]> {
    let side = |side: u32| u16::try_from(side).ok().filter(|side| *side <= 1 << 14);
    match (side(image.width), side(image.height)) {
        (Some(width), Some(height)) => Ok([width, height]),
        _ => Err(unwritten(
            path,
            "sides of over 16384 pixels are too long for this format",
        )),
    }
}

fn unwritten(path: &Path, error: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> Error {
    Error::Io {
        path: path.to_owned(),
        source: std::io::Error::other(error),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn film(name: &str) -> Vec<u8> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(name);
        let frame = |i: u32, image: &mut Image| {
            image.width = 5;
            image.height = 3;
            image.pixels = vec![[0.25 * i as f32, 0.5, 1.0, 1.0]; 15];
            Ok(())
        };
        write(&path, 4, FrameTime::THIRTIETH, frame).unwrap();
        std::fs::read(path).unwrap()
    }

    #[test]
    fn an_animated_webp_is_read_back_frame_by_frame() {
        let file = film("turn.webp");
        let mut decoder = image_webp::WebPDecoder::new(std::io::Cursor::new(file)).unwrap();
        assert!(decoder.is_animated());
        assert_eq!((decoder.num_frames(), decoder.dimensions()), (4, (5, 3)));
        assert_eq!(u32::from(decoder.loop_count() == image_webp::LoopCount::Forever), 1);
        let mut pixels = vec![0; decoder.output_buffer_size().unwrap()];
        let each = pixels.len() / 15;
        for red in [0u8, 64, 128, 191] {
            let milliseconds = decoder.read_frame(&mut pixels).unwrap();
            assert!((33..=34).contains(&milliseconds));
            assert!(
                pixels.chunks(each).all(|p| p[..3] == [red, 128, 255]),
                "{red}: {:?}",
                &pixels[..4]
            );
        }
    }

    #[test]
    fn an_animated_png_has_all_frames() {
        let file = film("turn.png");
        let mut reader = png::Decoder::new(std::io::Cursor::new(file)).read_info().unwrap();
        assert_eq!(reader.info().animation_control().map(|a| a.num_frames), Some(4));
        let mut pixels = vec![0; 5 * 3 * 4];
        for red in [0u8, 64, 128, 191] {
            reader.next_frame(&mut pixels).unwrap();
            assert_eq!(pixels[..4], [red, 128, 255, 255]);
        }
    }

    #[test]
    fn a_gif_has_all_frames() {
        let file = film("turn.gif");
        let mut options = gif::DecodeOptions::new();
        options.set_color_output(gif::ColorOutput::RGBA);
        let mut decoder = options.read_info(&file[..]).unwrap();
        let (mut reds, mut delays) = (Vec::new(), Vec::new());
        while let Some(frame) = decoder.read_next_frame().unwrap() {
            delays.push(frame.delay);
            reds.push(frame.buffer[0]);
        }
        assert_eq!(reds, [0, 64, 128, 191]);
        // Whole hundredths, which do not drift from the time.
        assert_eq!(delays, [3, 4, 3, 3]);
    }

    #[test]
    fn an_ending_that_is_no_video_is_refused() {
        assert!(kind_of(Path::new("turn.jpg")).is_err_and(|Failure(text)| text.contains(".webp")));
        assert_eq!(kind_of(Path::new("turn.MP4")).ok(), Some(Kind::Other));
    }
}
