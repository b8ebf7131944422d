//! LZF, the compression of PCD files.

/// Unpacks `code` to `length` bytes. `None` if it does not give exactly so many.
pub(super) fn unpack(code: &[u8], length: usize) -> Option<Vec<u8>> {
    // A byte of code gives at most 264/3 bytes, so that a length that is not true costs little.
    if length > code.len().saturating_mul(264) {
        return None;
    }
    let mut out: Vec<u8> = Vec::with_capacity(length);
    let mut code = code.iter().copied();
    while let Some(control) = code.next() {
        if control < 32 {
            for _ in 0..=control {
                out.push(code.next()?);
            }
        } else {
            let mut run = usize::from(control >> 5) + 2;
            if run == 9 {
                run += usize::from(code.next()?);
            }
            let back = (usize::from(control & 31) << 8 | usize::from(code.next()?)) + 1;
            let from = out.len().checked_sub(back)?;
            // Byte by byte: the run may overlap what it writes.
            for i in from..from + run {
                out.push(out[i]);
            }
        }
        if out.len() > length {
            return None;
        }
    }
    (out.len() == length).then_some(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn literals_and_runs_are_unpacked() {
        // "abc", then ten bytes from three back, then a long run of the last byte.
        let code = [2, b'a', b'b', b'c', 7 << 5, 1, 2, 7 << 5, 200, 0];
        let unpacked = unpack(&code, 3 + 10 + 209).unwrap();
        assert_eq!(&unpacked[..13], b"abcabcabcabca");
        assert!(unpacked[13..].iter().all(|b| *b == b'a'));
    }

    #[test]
    fn damaged_code_is_refused() {
        for code in [&[5, 1][..], &[1 << 5, 0], &[0, 9, 7 << 5], &[0, 9, 1 << 5, 4], &[0, 9]] {
            assert_eq!(unpack(code, 4), None, "{code:?}");
        }
        assert_eq!(unpack(&[], usize::MAX), None);
    }
}
