//! Numbers of up to 13 bits as two digits that fit bytes.

/// The largest magnitude of a number whose [`digits`], and their sum, are signed bytes.
pub(crate) const REACH: i16 = 4095;

/// `(high, low)` with `x = 64·high + low`.
///
/// Three products of digits make one of numbers: `high·high`, `low·low`, and `(high + low)·(high + low)`, which
/// contains them and the mixed ones (Karatsuba). Added modulo 2³², as everywhere, sums are equal to the bit.
pub(crate) fn digits(x: i16) -> (i8, i8) {
    let high = (x + 32) >> 6;
    (high as i8, (x - (high << 6)) as i8)
}
