//! What levels say of their colours.

use super::*;

/// A stream whose last level has no latents, and these filters.
fn filtered(filters: &[(u8, usize, &[u8])]) -> Result<Vec<u8>> {
    let mut writer = Writer::new(header())?;
    writer.geometry(1, &[(2, b"one")])?;
    writer.geometry(2, &[(3, b"second")])?;
    writer.features(2, HASHES[0], &[b"latents 2"])?;
    writer.geometry(3, &[(10, b"")])?;
    writer.features(3, HASHES[1], &[b"a", b"b", b"c"])?;
    for (level, slice, payload) in filters {
        if *level == 3 {
            writer.filter(3, *slice, payload)?;
        }
    }
    writer.geometry(4, &[(8, b"x"), (8, b"y"), (4, b"z")])?;
    for (level, slice, payload) in filters {
        if *level == 4 {
            writer.filter(4, *slice, payload)?;
        }
    }
    writer.finish()
}

#[test]
fn filters_follow_latents_or_stand_where_there_are_none() {
    let bytes = filtered(&[(3, 0, b"best"), (4, 1, b"quick")]).unwrap();
    let stream = parse(&bytes).unwrap().intact().unwrap();
    let [base, middle, top] = stream.levels() else {
        panic!("three levels")
    };
    let codes = |level: &Level| level.filters.map(|f| f.map(|f| (f.voxels, f.bytes.to_vec())));
    assert_eq!(codes(base), [None, None]);
    assert_eq!(codes(middle), [Some((10, b"best".to_vec())), None]);
    assert_eq!(codes(top), [None, Some((20, b"quick".to_vec()))]);
    assert_eq!(middle.features.len(), 3);
    assert!(top.features.is_empty());
    let filter = top.filters[1].unwrap();
    assert_eq!(&bytes[filter.offset..][..5], b"quick");
}

#[test]
fn filters_out_of_order_twice_or_of_unknown_heads_are_refused() {
    for filters in [
        [(3, 1, &b"quick"[..]), (3, 0, b"best")],
        [(3, 0, b"best"), (3, 0, b"best")],
        [(3, 0, b"best"), (3, 2, b"what")],
        [(4, 1, b"quick"), (4, 0, b"best")],
    ] {
        let error = filtered(&filters).unwrap_err().to_string();
        assert!(error.contains("after the section's last"), "{error}");
    }
}

#[test]
fn a_filter_for_another_number_of_voxels_is_refused() {
    let mut bytes = filtered(&[(4, 0, b"best")]).unwrap();
    let at = bytes.len() - CHUNK_HEADER - 4;
    bytes[at + 4] = 19;
    seal_chunks(&mut bytes, at);
    let error = parse(&bytes).unwrap().require(4).unwrap_err().to_string();
    assert!(error.contains("is 19, expected 20 to 20"), "{error}");
}

/// The same with filters at the top level, and what follows them.
fn refined(slices: &[&[u8]]) -> Result<Vec<u8>> {
    let stream = filtered(&[(4, 0, b"best")])?;
    let stream = parse(&stream)?;
    let mut writer = Writer::new(stream.header().clone())?;
    for level in stream.levels() {
        for part in &level.geometry {
            let slices = part.slices.iter().map(|slice| (slice.voxels, slice.bytes));
            writer.geometry(part.level, &slices.collect::<Vec<_>>())?;
        }
        if !level.features.is_empty() {
            let slices: Vec<_> = level.features.iter().map(|slice| slice.bytes).collect();
            writer.features(level.level, level.latent_hash, &slices)?;
        }
    }
    writer.filter(4, 0, b"best")?;
    writer.residual(4, slices)?;
    writer.finish()
}

/// As many as 20 voxels fill.
const SLICES: [&[u8]; 5] = [b"1", b"2", b"3", b"4", b"5"];

#[test]
fn a_residual_has_a_chunk_for_every_slice_after_the_filters() {
    let bytes = refined(&SLICES).unwrap();
    let stream = parse(&bytes).unwrap().intact().unwrap();
    let [base, middle, top] = stream.levels() else {
        panic!("three levels")
    };
    assert!(base.residual.is_empty() && middle.residual.is_empty() && top.features.is_empty());
    assert!(top.filters[0].is_some() && top.filters[1].is_none());
    let codes: Vec<_> = top.residual.iter().map(|s| (s.voxels, s.bytes)).collect();
    assert_eq!(codes, SLICES.map(|code| (4, code)));
    assert_eq!(bytes[top.residual[3].offset], b'4');
}

#[test]
fn a_residual_with_slices_missing_too_many_or_of_other_sizes_is_refused() {
    for slices in [&SLICES[..4], &[SLICES, SLICES].concat()] {
        assert!(matches!(refined(slices), Err(Error::Usage(_))));
    }
    let whole = refined(&SLICES).unwrap();
    let size = CHUNK_HEADER + 1;
    let error = |bytes: &[u8]| parse(bytes).unwrap().require(4).unwrap_err().to_string();
    // The last chunk is an ancillary one instead, the third has fewer voxels, the second comes twice.
    let last = whole.len() - size;
    for (at, byte, value, told) in [
        (last, 0, 200, "residual chunk of level 4, slice 4"),
        (last - 2 * size, 4, 3, "is 3, expected 4 to 4"),
        (last - 3 * size, 2, 0, "slice 1"),
    ] {
        let mut bytes = whole.clone();
        bytes[at + byte] = value;
        seal_chunks(&mut bytes, at);
        assert!(error(&bytes).contains(told), "{}", error(&bytes));
    }
}
