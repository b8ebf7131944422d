//! Upper bounds of memory: sums of terms, each so many bytes for each of something that a header counts.
//!
//! `SECURITY.md` has the same terms as tables. A test of the decoder compares them.

/// Sizes of a model that bytes may be a multiple of.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Sizes {
    /// C: channels.
    pub channels: u64,
    /// K: latents of a voxel.
    pub latents: u64,
    /// H: channels of the Gaussian generator.
    pub generator: u64,
    /// B: channels of the network that predicts the base level.
    pub base: u64,
}

/// One term of a bound.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Term {
    /// What there is a number of.
    #[cfg_attr(not(test), expect(dead_code, reason = "the tables of SECURITY.md show it"))]
    pub each: &'static str,
    /// What takes the bytes.
    #[cfg_attr(not(test), expect(dead_code, reason = "the tables of SECURITY.md show it"))]
    pub takes: &'static str,
    /// Bytes of each, whatever the model.
    pub fixed: u64,
    /// Bytes of each and of each unit of a model's sizes.
    pub by: Sizes,
}

/// A term of no bytes by the model's sizes.
pub(crate) const NOTHING: Sizes = Sizes {
    channels: 0,
    latents: 0,
    generator: 0,
    base: 0,
};

impl Term {
    /// Bytes of one, with a model of these sizes.
    pub fn bytes(&self, sizes: Sizes) -> u64 {
        self.fixed
            + self.by.channels * sizes.channels
            + self.by.latents * sizes.latents
            + self.by.generator * sizes.generator
            + self.by.base * sizes.base
    }

    /// Bytes of so many, with a model of these sizes; `u64::MAX` if they are more than that.
    pub fn times(&self, count: u64, sizes: Sizes) -> u64 {
        self.bytes(sizes).saturating_mul(count)
    }
}

/// Bytes of all terms, each with its count; `u64::MAX` if they are more than that.
pub(crate) fn total(terms: &[(Term, u64)], sizes: Sizes) -> u64 {
    let bytes = terms.iter().map(|(term, count)| term.times(*count, sizes));
    bytes.fold(0, u64::saturating_add)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZES: Sizes = Sizes {
        channels: 2,
        latents: 3,
        generator: 5,
        base: 7,
    };

    fn term(fixed: u64, by: Sizes) -> Term {
        Term {
            each: "",
            takes: "",
            fixed,
            by,
        }
    }

    #[test]
    fn a_bound_is_the_sum_of_its_terms() {
        let by = Sizes {
            channels: 11,
            latents: 13,
            generator: 17,
            base: 19,
        };
        let one = term(23, by);
        assert_eq!(one.bytes(NOTHING), 23);
        assert_eq!(one.bytes(SIZES), 23 + 2 * 11 + 3 * 13 + 5 * 17 + 7 * 19);
        assert_eq!(one.times(10, SIZES), 3020);
        assert_eq!(total(&[(one, 10), (term(4, NOTHING), 3)], SIZES), 3032);
        assert_eq!(total(&[], SIZES), 0);
    }

    #[test]
    fn a_bound_that_is_too_large_to_count_is_the_greatest_number() {
        let four = term(4, NOTHING);
        assert_eq!(four.times(u64::MAX / 2, SIZES), u64::MAX);
        assert_eq!(total(&[(four, u64::MAX / 4), (four, 1)], SIZES), u64::MAX);
    }
}
