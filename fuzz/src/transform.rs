//! Untrusted streams of version 3.

use b2p::container::{Colours, Level, Writer};
use b2p::gaussians::Gaussians;
use b2p::{Decoder, Decoding};
use b2p::{Error, Limits};

use crate::streams::check;
use crate::{giving_back, one_in, within};

/// So little that a level of it is decoded in a fraction of a millisecond, what its coefficients teach apart.
pub(crate) fn limits() -> Limits {
    Limits::default().with_max_points(1 << 8).with_max_bytes(16 << 20)
}

/// Writes a level as it was read.
pub(crate) fn rewrite(writer: &mut Writer, level: &Level, colours: &Colours) {
    let mut geometry = level.geometry.iter().peekable();
    let base = colours.trunk.is_some();
    if base && level.level > 0 {
        // Levels of one slice were in the trunk, or could have been.
        let mut trunk = Vec::new();
        while let Some(part) = geometry.next_if(|part| part.slices.len() == 1) {
            trunk.push((part.slices[0].voxels, part.slices[0].bytes));
        }
        writer.geometry_trunk(&trunk).expect("a level of it");
    }
    for part in geometry {
        let slices = part.slices.iter().map(|slice| (slice.voxels, slice.bytes));
        let slices: Vec<_> = slices.collect();
        writer.geometry(part.level, &slices).expect("a level of it");
    }
    if let Some(trunk) = &colours.trunk {
        let (voxels, payload) = (trunk.slice.voxels, trunk.slice.bytes);
        let written = writer.colour_trunk(trunk.level, voxels, colours.hash, payload);
        written.expect("a level of it");
    }
    for part in &colours.levels {
        let slices = part.slices.iter().map(|slice| (slice.voxels, slice.bytes));
        let slices: Vec<_> = slices.collect();
        let hash = (!base).then_some(colours.hash);
        let written = writer.colours(part.level, hash, &slices);
        written.expect("a level of it");
    }
    if let Some(filter) = &colours.filter {
        let written = writer.post_filter(level.level, filter.bytes);
        written.expect("a level of it");
    }
}

/// Any bytes under small limits, whole and in pieces whose sizes the last bytes tell: an error, or as many voxels with
/// colours, and finite Gaussians of them, as the header tells; the same both times. A level that is refused leaves
/// those before it as they were, no level takes more memory than it may, and all of it is given back. A check of the
/// stream finds the same, and names the clause of each fault. Gaussians that come in parts are those that come at once.
pub fn transform(bytes: &[u8]) {
    giving_back(|| decoded(bytes));
}

fn decoded(bytes: &[u8]) {
    let decoder = Decoder::new().with_limits(limits());
    let mut decoding = decoder.start();
    decoding.push(bytes);
    let most = (limits().max_bytes + Limits::OVERHEAD) as usize;
    let mut reached = None;
    let error = loop {
        match within(most, || decoding.advance()) {
            Ok(Some(level)) => {
                let header = decoding.header().expect("a level has a header before it");
                let voxels = header.voxels(level).expect("a level of the stream") as usize;
                let found = points(&decoding).expect("a level was decoded");
                assert_eq!((found.0.len(), found.1.len()), (voxels, voxels));
                reached = Some(found);
            }
            Ok(None) => break decoding.finish().err(),
            Err(error) => break Some(error),
        }
    };
    assert!(points(&decoding) == reached, "damage reached back");
    if let Some(error) = &error {
        match error {
            Error::ModelMissing { .. } => (),
            error => check(error),
        }
    }
    if one_in(2, bytes) {
        let checked = decoder.check(bytes);
        let limited = matches!(error, Some(Error::LimitExceeded { .. }));
        assert!(limited || checked.is_valid() == error.is_none(), "{checked:?}");
        assert!(
            checked.faults.iter().all(|fault| fault.error.clause().is_some()),
            "{checked:?}"
        );
    }
    if reached.is_some() && one_in(2, bytes) {
        let gaussians = within(most, || decoding.gaussians()).expect("every level is drawn");
        finite(&gaussians);
        if error.is_none() {
            let parts = within(most, || in_parts(&decoder, bytes));
            assert!(parts == gaussians, "parts are other Gaussians");
        }
    }
    if one_in(3, bytes) {
        let told = |error: Option<Error>| error.map(|error| error.to_string());
        let (found, again) = pieced(&decoder, bytes);
        assert!(found == reached, "pieces decode to something else");
        assert_eq!(told(again), told(error));
    }
}

/// The voxels and colours of the level reached.
fn points(decoding: &Decoding) -> Option<(Vec<u64>, Vec<[u8; 3]>)> {
    let points = decoding.points()?;
    Some((points.voxels.keys().to_vec(), points.colours.to_vec()))
}

type Found = (Option<(Vec<u64>, Vec<[u8; 3]>)>, Option<Error>);

fn pieced(decoder: &Decoder, bytes: &[u8]) -> Found {
    let sizes = bytes.iter().rev().take(3).map(|size| usize::from(*size) + 1);
    let sizes: Vec<usize> = sizes.collect();
    let mut decoding = decoder.start();
    let mut rest = bytes;
    let mut sizes = sizes.into_iter().cycle();
    let result = (|| {
        while !rest.is_empty() {
            let size = sizes.next().unwrap_or(1).min(rest.len());
            let (piece, after) = rest.split_at(size);
            decoding.push(piece);
            rest = after;
            while decoding.advance()?.is_some() {}
        }
        decoding.finish()
    })();
    (points(&decoding), result.err())
}

/// The Gaussians of a whole stream, put together from parts.
fn in_parts(decoder: &Decoder, bytes: &[u8]) -> Gaussians {
    let mut whole = Gaussians::default();
    let each = |part: &Gaussians| {
        part.check_lengths()?;
        whole.position.extend(&part.position);
        whole.scale.extend(&part.scale);
        whole.rotation.extend(&part.rotation);
        whole.opacity.extend(&part.opacity);
        whole.colour.extend(&part.colour);
        (whole.frame, whole.blur, whole.compensated) = (part.frame, part.blur, part.compensated);
        Ok(())
    };
    decoder
        .decode_in_parts(bytes, each)
        .expect("a stream that decodes, decodes in parts");
    whole
}

fn finite(gaussians: &Gaussians) {
    gaussians.check_lengths().expect("arrays of one length");
    let positions = gaussians.position.as_flattened().iter();
    let mut floats = positions.chain(gaussians.rotation.as_flattened());
    assert!(floats.all(|v| v.is_finite()));
    let mut scales = gaussians.scale.as_flattened().iter();
    assert!(scales.all(|v| v.is_finite() && *v >= 0.0));
}
