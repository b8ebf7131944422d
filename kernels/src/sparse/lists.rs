//! Sorting a kernel map's entries by tap.

use super::taps::ABSENT;

/// A tile of a kernel map, and where its pairs go.
pub(crate) struct Lists<'a> {
    /// One entry per row and tap.
    pub map: &'a [u32],
    /// To be written, one per tap.
    pub lengths: &'a mut [usize],
    /// `room` for each tap.
    pub inputs: &'a mut [u32],
    /// Likewise.
    pub rows: &'a mut [u32],
    /// One per row, zero so far.
    pub masks: &'a mut [u64],
    /// More than there are rows.
    pub room: usize,
}

/// Sorts a kernel map's entries by tap, and gives the end of the input rows that it names.
pub(super) fn fill_map(lists: Lists<'_>) -> usize {
    let mut end = 0;
    let volume = lists.lengths.len();
    for (k, length) in lists.lengths.iter_mut().enumerate() {
        let inputs = &mut lists.inputs[k * lists.room..][..lists.room];
        let rows = &mut lists.rows[k * lists.room..][..lists.room];
        let taps = lists.map.chunks_exact(volume);
        for (row, (taps, mask)) in taps.zip(&mut *lists.masks).enumerate() {
            let input = taps[k];
            let used = input != ABSENT;
            // Written in any case, kept only if used: a branch here would be mispredicted.
            inputs[*length] = input;
            rows[*length] = row as u32;
            *length += usize::from(used);
            *mask |= u64::from(used) << k;
            end = end.max(input.wrapping_add(1));
        }
    }
    end as usize
}
