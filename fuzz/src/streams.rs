//! Untrusted streams.

use b2p::Decoder;
use b2p::container::{self, Header, Level, Slice, Stream, Writer};
use b2p::gaussians::Gaussians;
use b2p::latents::{Exact, LatentDecoder, LatentDecoding};
use b2p::log::Log;
use b2p::{Axes, Error, Limits};

use crate::{MODEL, giving_back, one_in, transform, within};

/// So little that a level of it is decoded in a fraction of a millisecond.
pub(crate) fn limits() -> Limits {
    Limits::default().with_max_points(1 << 8).with_max_bytes(2 << 20)
}

/// Any bytes: an error, or a header that is within the limits and is written back as it was read, whose levels, where
/// they are whole, have as many voxels as it tells; a whole stream is written back as it was read, but for chunks that
/// may be skipped. Reading takes memory in proportion to the bytes that are there, whatever they say.
pub fn header(bytes: &[u8]) {
    let limits = limits();
    let most = 4096 + 16 * bytes.len();
    let Ok(header) = within(most, || Header::parse(bytes, &limits)) else {
        return;
    };
    let mut written = header.write();
    // A later minor version is read like this one.
    written[10..12].copy_from_slice(&bytes[10..12]);
    let end = written.len() - 4;
    assert_eq!(written[..end], bytes[..end], "the header changed on its way");
    assert!(header.points <= limits.max_points);
    let stream = within(most, || Stream::parse(bytes, &limits)).expect("the header is sound");
    assert!(stream.levels().len() <= header.voxels.len());
    for (level, voxels) in stream.levels().iter().zip(&header.voxels) {
        let slices = level
            .geometry
            .last()
            .map_or(1, |geometry| geometry.slices.iter().map(|slice| slice.voxels).sum());
        assert_eq!(slices, *voxels);
        let latents: u32 = level.features.iter().map(|slice| slice.voxels).sum();
        assert!(latents == *voxels || level.features.is_empty());
        for filter in level.filters.iter().flatten() {
            assert_eq!(filter.voxels, *voxels);
        }
        let residual: u32 = level.residual.iter().map(|slice| slice.voxels).sum();
        assert!(residual == *voxels || level.residual.is_empty());
        let end = header.prefix_bytes(level.level).expect("a level of the stream");
        assert!(end <= bytes.len() as u64);
    }
    let axes = container::axes(bytes).expect("the header is sound");
    assert!(axes.crs.len() <= Axes::MAX_CRS);
    if let Ok(marked) = container::with_axes(bytes, &axes) {
        assert_eq!(container::axes(&marked).expect("a sound header"), axes);
    }
    let whole = stream.levels().len() == header.voxels.len();
    let exact = bytes.len() as u64 == header.stream_bytes();
    assert_eq!(stream.damage().is_none(), whole && exact);
    assert_eq!(*stream.header(), header);
    if stream.damage().is_none() {
        let written = rewritten(&stream, None);
        assert_eq!(
            written,
            rewritten(&Stream::parse(&written, &limits).expect("a stream"), None)
        );
        assert!(written.len() <= bytes.len());
        if written.len() == bytes.len() {
            assert_eq!(written[header.bytes()..], bytes[header.bytes()..]);
        }
    }
    requests(bytes, &header, stream.deepest());
}

/// The same stream, put together from its parts; with `colours`, if there are any, as the payload of all colour filters
/// and the slices of a residual of each level.
pub(crate) fn rewritten(stream: &Stream, colours: Option<&Colours<'_>>) -> Vec<u8> {
    let mut writer = Writer::new(stream.header().clone()).expect("a header that was read");
    for level in stream.levels() {
        if let Some(colours) = &level.colours {
            transform::rewrite(&mut writer, level, colours);
            continue;
        }
        for part in &level.geometry {
            let slices = part.slices.iter().map(|slice| (slice.voxels, slice.bytes));
            let slices: Vec<_> = slices.collect();
            writer.geometry(part.level, &slices).expect("a level of it");
        }
        if !level.features.is_empty() {
            let mut slices = with_excess(&level.features);
            let excess = writer.features(level.level, level.latent_hash, &slices);
            assert!(excess.is_err(), "more slices than the voxels fill");
            slices.pop();
            writer
                .features(level.level, level.latent_hash, &slices)
                .expect("a level of it");
        }
        for (slice, own) in level.filters.iter().enumerate() {
            let made = colours.map(|colours| &colours.filter[..]);
            if let Some(payload) = made.or(own.map(|own| own.bytes)) {
                let written = writer.filter(level.level, slice, payload);
                written.expect("a level of it");
            }
        }
        if let Some(colours) = colours {
            let written = writer.residual(level.level, &(colours.residual)(level));
            written.expect("a level of it");
        } else if !level.residual.is_empty() {
            let mut slices = with_excess(&level.residual);
            let excess = writer.residual(level.level, &slices);
            assert!(excess.is_err(), "more slices than the voxels fill");
            slices.pop();
            let written = writer.residual(level.level, &slices);
            written.expect("a level of it");
        }
    }
    writer.finish().expect("the parts of a whole stream")
}

/// The code of slices, and of one more.
fn with_excess<'a>(slices: &[Slice<'a>]) -> Vec<&'a [u8]> {
    let codes = slices.iter().map(|slice| slice.bytes);
    codes.chain([&[][..]]).collect()
}

/// What all levels of a stream are to say of their colours.
pub(crate) struct Colours<'a> {
    pub filter: Vec<u8>,
    pub residual: &'a dyn Fn(&Level) -> Vec<Vec<u8>>,
}

/// A level can be asked for if it is whole; a prefix is intact if it ends with a level; a header has as many voxel
/// counts as levels.
fn requests(bytes: &[u8], header: &Header, deepest: Option<u8>) {
    let stream = || Stream::parse(bytes, &limits()).expect("the header is sound");
    for level in header.base.saturating_sub(1)..=header.top + 1 {
        let whole = level >= header.base && deepest.is_some_and(|deepest| level <= deepest);
        assert_eq!(stream().require(level).is_ok(), whole);
    }
    let length = deepest.map(|level| header.prefix_bytes(level).expect("a level of the stream"));
    let intact = length == Some(bytes.len() as u64);
    assert_eq!(stream().intact().is_ok(), intact);
    let mut other = header.clone();
    other.voxels.pop();
    assert!(Writer::new(other).is_err());
}

/// The finest level that a stream decodes to.
///
/// # Errors
/// What the decoder says.
pub fn deepest(bytes: &[u8]) -> Result<Option<u8>, Error> {
    let log = &Log::default();
    if b2p::container::version(bytes) == Some(3) {
        let decoder = Decoder::new().with_limits(transform::limits());
        return Ok(decoder.whole(bytes)?.level());
    }
    let mut decoding = LatentDecoder::new(&MODEL).with_limits(limits()).start(None);
    decoding.push(bytes);
    decoding.finish(log)?;
    Ok(decoding.level())
}

/// Any bytes under small limits: an error, or as many finite Gaussians as the header tells, and again the same ones; a
/// level that is refused leaves those before it as they were, no level takes more memory than it may, and all of it is
/// given back. For one input in four the Gaussians of all levels, and everything twice.
pub fn stream(bytes: &[u8]) {
    giving_back(|| decoded(bytes));
}

fn decoded(bytes: &[u8]) {
    let decoder = LatentDecoder::new(&MODEL).with_limits(limits());
    let (mut decoding, log) = (decoder.start(None), Log::default());
    decoding.push(bytes);
    let most = (limits().max_bytes + Limits::OVERHEAD) as usize;
    let thorough = one_in(4, bytes);
    let mut reached: Option<(Exact, Option<Gaussians>)> = None;
    let error = loop {
        match within(most, || decoding.advance(&log)) {
            Ok(Some(level)) => {
                let header = decoding.header().expect("a level has a header before it");
                let voxels = header.voxels(level).expect("a level of the stream") as usize;
                let exact = decoding.exact().expect("a level was decoded");
                assert_eq!(exact.octree.depth(), level);
                assert_eq!(exact.octree.level(level).len(), voxels);
                let latents = MODEL.shape().latents_of(usize::from(level - header.base));
                assert_eq!(exact.latents.len(), voxels * latents);
                let seen = thorough.then(|| gaussians(&decoding, &log));
                reached = Some((exact.clone(), seen.flatten()));
            }
            Ok(None) => break decoding.finish(&log).err(),
            Err(error) => break Some(error),
        }
    };
    let exact = reached.as_ref().map(|(exact, _)| exact);
    assert_eq!(decoding.exact(), exact, "damage reached back");
    let last = gaussians(&decoding, &log);
    if let (true, Some((_, seen))) = (thorough, &reached) {
        assert_eq!(last, *seen, "damage reached back");
    }
    match error {
        Some(error) => check(&error),
        None if thorough && last.is_some() => {
            let whole = decoder.decode(bytes, None, &log).ok();
            assert_eq!(whole, last, "decoding twice gives two results");
        }
        None => (),
    }
}

/// The Gaussians of the level reached, if it has any.
fn gaussians(decoding: &LatentDecoding, log: &Log) -> Option<Gaussians> {
    if !decoding.is_drawable() {
        return None;
    }
    let voxels = decoding.exact().map_or(0, |exact| {
        let octree = &exact.octree;
        octree.level(octree.depth()).len()
    });
    let gaussians = match decoding.gaussians(log) {
        Err(Error::LimitExceeded { .. }) => return None,
        gaussians => gaussians.expect("a drawable level has Gaussians"),
    };
    gaussians.check_lengths().expect("arrays of one length");
    assert!([voxels, 8 * voxels].contains(&gaussians.len()));
    assert!(gaussians.position.as_flattened().iter().all(|v| v.is_finite()));
    assert!(
        gaussians
            .scale
            .as_flattened()
            .iter()
            .all(|v| v.is_finite() && *v >= 0.0)
    );
    assert!(gaussians.opacity.iter().all(|v| (0.0..=1.0).contains(v)));
    Some(gaussians)
}

/// An error of a stream is one of those that the documentation names, and says something.
pub(crate) fn check(error: &Error) {
    assert!(!error.to_string().is_empty());
    assert!(matches!(
        error,
        Error::Truncated { .. }
            | Error::ChecksumMismatch { .. }
            | Error::ModelMismatch { .. }
            | Error::DeterminismMismatch { .. }
            | Error::LimitExceeded { .. }
            | Error::Unsupported { .. }
            | Error::Malformed { .. }
    ));
}

/// Any bytes in any pieces, which the last bytes tell the sizes of: result and error are those of the whole, and all
/// memory is given back.
pub fn chunking(bytes: &[u8]) {
    giving_back(|| pieced(bytes));
}

fn pieced(bytes: &[u8]) {
    let (sizes, level) = match bytes {
        [.., a, b, c, level] => ([*a, *b, *c], [None, Some(2), Some(3)][usize::from(level % 3)]),
        _ => ([1; 3], None),
    };
    let decoder = LatentDecoder::new(&MODEL).with_limits(limits());
    let log = Log::default();
    let mut whole = decoder.start(level);
    whole.push(bytes);
    let expected = whole.finish(&log).map_err(|error| error.to_string());
    let mut pieces = decoder.start(level);
    let mut rest = bytes;
    let mut sizes = sizes.into_iter().cycle();
    let result = (|| {
        while !rest.is_empty() {
            let size = usize::from(sizes.next().unwrap_or(1)).clamp(1, rest.len());
            let (piece, after) = rest.split_at(size);
            pieces.push(piece);
            rest = after;
            while pieces.advance(&log)?.is_some() {}
        }
        pieces.finish(&log)
    })();
    assert_eq!(result.map_err(|error| error.to_string()), expected);
    assert_eq!(pieces.level(), whole.level());
    assert_eq!(pieces.exact(), whole.exact());
}
