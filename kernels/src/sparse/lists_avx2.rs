//! Sorting a kernel map's entries by tap, eight rows by eight taps at a time.

use std::arch::x86_64::*;

use bytemuck::must_cast;

use super::lists::Lists;
use crate::simd::avx2::{Avx2, FIRST, with_avx2};

/// How many entries before they are read the map's are fetched.
const AHEAD: usize = 1024;

/// Fills the lists, and gives the end of the input rows that the map names.
///
/// # Panics
/// If a list is shorter than [`Lists`] says, or `lists.room` is less than eight more than there are rows.
pub(super) fn fill_map(_: Avx2, lists: Lists<'_>) -> usize {
    // SAFETY: the token proves the features.
    unsafe { fill(lists) }
}

with_avx2! {
    fn fill(lists: Lists<'_>) -> usize {
        let Lists { map, lengths, inputs, rows, masks, room } = lists;
        let (volume, count) = (lengths.len(), masks.len());
        assert_eq!(map.len(), volume * count, "one entry per row and tap");
        assert!(inputs.len() >= volume * room && rows.len() >= volume * room && room >= count + 8);
        let absent = _mm256_set1_epi32(-1);
        let lane = must_cast([0, 1, 2, 3, 4, 5, 6, 7]);
        let mut ends = _mm256_setzero_si256();
        for first in (0..count).step_by(8) {
            // The map is larger than the caches, and each entry is read once.
            let ahead = map.as_ptr().wrapping_add(first * volume + AHEAD);
            for line in (0..8 * volume).step_by(16) {
                _mm_prefetch::<_MM_HINT_T0>(ahead.wrapping_add(line).cast());
            }
            for tap in (0..volume).step_by(8) {
                let taps = (volume - tap).min(8);
                let here = _mm256_cmpgt_epi32(_mm256_set1_epi32(taps as i32), lane);
                let mut block = [absent; 8];
                for (row, block) in block.iter_mut().enumerate().take(count - first) {
                    let from = &map[(first + row) * volume + tap..][..taps];
                    *block = match from.first_chunk::<8>() {
                        Some(from) => must_cast(*from),
                        // SAFETY: only the lanes below `taps` are read, which are `from`.
                        None => unsafe { _mm256_maskload_epi32(from.as_ptr().cast(), here) },
                    };
                    let used = _mm256_andnot_si256(_mm256_cmpeq_epi32(*block, absent), here);
                    let used = _mm256_movemask_ps(_mm256_castsi256_ps(used)) as u64;
                    masks[first + row] |= used << tap;
                }
                let block = transpose(block);
                for (k, &entries) in (tap..tap + taps).zip(&block) {
                    let used = !_mm256_movemask_ps(_mm256_castsi256_ps(_mm256_cmpeq_epi32(entries, absent)));
                    let used = (used & 0xff) as usize;
                    ends = _mm256_max_epu32(ends, _mm256_sub_epi32(entries, absent));
                    let places = _mm256_cvtepu8_epi32(must_cast([FIRST[used], 0]));
                    // No list is longer than the rows before this block: eight more words fit into its room.
                    let at = k * room + lengths[k];
                    let kept = _mm256_permutevar8x32_epi32(entries, places);
                    inputs[at..][..8].copy_from_slice(&must_cast::<_, [u32; 8]>(kept));
                    let kept = _mm256_add_epi32(places, _mm256_set1_epi32(first as i32));
                    rows[at..][..8].copy_from_slice(&must_cast::<_, [u32; 8]>(kept));
                    lengths[k] += used.count_ones() as usize;
                }
            }
        }
        must_cast::<_, [u32; 8]>(ends).into_iter().fold(0, u32::max) as usize
    }
}

with_avx2! {
    /// Vector i of the result has entry i of each vector.
    #[inline]
    fn transpose(rows: [__m256i; 8]) -> [__m256i; 8] {
        let [a, b, c, d, e, f, g, h] = rows;
        let (ab, cd) = (
            [_mm256_unpacklo_epi32(a, b), _mm256_unpackhi_epi32(a, b)],
            [_mm256_unpacklo_epi32(c, d), _mm256_unpackhi_epi32(c, d)],
        );
        let (ef, gh) = (
            [_mm256_unpacklo_epi32(e, f), _mm256_unpackhi_epi32(e, f)],
            [_mm256_unpacklo_epi32(g, h), _mm256_unpackhi_epi32(g, h)],
        );
        let mut out = rows;
        for half in 0..2 {
            let low = [
                _mm256_unpacklo_epi64(ab[half], cd[half]),
                _mm256_unpackhi_epi64(ab[half], cd[half]),
            ];
            let high = [
                _mm256_unpacklo_epi64(ef[half], gh[half]),
                _mm256_unpackhi_epi64(ef[half], gh[half]),
            ];
            for i in 0..2 {
                out[2 * half + i] = _mm256_permute2x128_si256::<0x20>(low[i], high[i]);
                out[2 * half + i + 4] = _mm256_permute2x128_si256::<0x31>(low[i], high[i]);
            }
        }
        out
    }
}
