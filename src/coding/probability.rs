//! From a logit to a probability, by a table of integers, and back.

use super::ONE;

/// The largest logit in use, in units of 1/64: the probability stops short of certainty.
pub(crate) const LIMIT: i32 = 720;

/// `e^(−1/64)` in units of 2^−62, rounded down.
const DECAY: u64 = 4_540_188_453_729_421_604;

/// Entry `k` is `round(2^16 / (1 + E))` with `E = e^(−k/64)` in units of 2^−62: `E` of `k = 0` is 2^62, and each next
/// one is the last times `DECAY`, divided by 2^62, rounded down.
const SQUASH: [u16; LIMIT as usize + 1] = {
    let mut table = [0; LIMIT as usize + 1];
    let mut power = 1u128 << 62;
    let mut k = 0;
    while k < table.len() {
        let denominator = (1u128 << 62) + power;
        table[k] = (((1u128 << 78) + denominator / 2) / denominator) as u16;
        power = (power * DECAY as u128) >> 62;
        k += 1;
    }
    table
};

/// The same for logits from −[`LIMIT`] to [`LIMIT`]: that of `-k` is 2^16 less that of `k`.
static ONE_OF: [u16; 2 * LIMIT as usize + 1] = {
    let mut table = [0; 2 * LIMIT as usize + 1];
    let mut i = 0;
    while i < table.len() {
        table[i] = one_of(i as i32 - LIMIT) as u16;
        i += 1;
    }
    table
};

const fn one_of(logit: i32) -> u32 {
    let one = SQUASH[logit.unsigned_abs() as usize] as u32;
    if logit < 0 { ONE - one } else { one }
}

/// The probability, in `1..=65535`, of a bit whose logit is `logit / 64`.
#[inline(always)]
pub(crate) fn squash(logit: i32) -> u32 {
    ONE_OF[(logit.clamp(-LIMIT, LIMIT) + LIMIT) as usize].into()
}

/// Entry `i` is the least logit whose probability is at least `16·i + 8`, or −[`LIMIT`].
pub(crate) static STRETCH: [i16; 1 << 12] = {
    let mut table = [0; 1 << 12];
    let (mut i, mut logit) = (0, -LIMIT);
    while i < table.len() {
        while logit < LIMIT && one_of(logit) < 16 * i as u32 + 8 {
            logit += 1;
        }
        table[i] = logit as i16;
        i += 1;
    }
    table
};

#[cfg(test)]
mod tests {
    use super::*;

    fn stretch(one: u16) -> i32 {
        STRETCH[usize::from(one >> 4)].into()
    }

    #[test]
    fn stretching_undoes_squashing() {
        for one in 1..=u16::MAX {
            let back = squash(stretch(one)) as i32;
            let step = squash(stretch(one) + 1) as i32 - back;
            assert!((back - i32::from(one)).abs() <= 16 + step, "{one}: {back}");
        }
        let ends = [stretch(0), stretch(u16::MAX)];
        assert_eq!(ends.map(|logit| squash(logit) >> 4), [0, 4095]);
    }

    #[test]
    fn the_table_is_the_logistic_function() {
        for logit in -1000..=1000 {
            let x = f64::from(logit.clamp(-LIMIT, LIMIT)) / 64.0;
            let exact = 65536.0 / (1.0 + (-x).exp());
            assert!((f64::from(squash(logit)) - exact).abs() < 0.500_001, "{logit}");
            assert!((1..ONE).contains(&squash(logit)));
        }
    }
}
