//! What is around the nodes of a brick: where their children find their neighbours (`docs/format.md`, clause 2.4).

/// Cells whose x is 0, and below 3, and the same of y, by `x + 4y + 16z`.
const X: [u64; 2] = [0x1111_1111_1111_1111, 0x7777_7777_7777_7777];
const Y: [u64; 2] = [0x000f_000f_000f_000f, 0x0fff_0fff_0fff_0fff];

/// The windows of the eight nodes of 2³ cells of a brick of 4³, by octant: the 4³ cells from one before the node on, as a
/// mask by `x + 4y + 16z`. `bricks` has the cells of 4³ bricks, x fastest, as such masks; the first of the 3³ around the
/// brick is at `first`.
#[inline(always)]
pub fn windows(bricks: &[u64; 64], first: usize) -> [u64; 8] {
    // The cells are halved along z, then along y, then along x.
    let mut columns = [[0; 2]; 9];
    for (i, column) in columns.iter_mut().enumerate() {
        let at = first + i % 3 + 4 * (i / 3);
        let [low, own, high] = [at, at + 16, at + 32].map(|at| bricks[at & 63]);
        *column = [low >> 48 | own << 16, own >> 16 | high << 48];
    }
    let mut windows = [0; 8];
    for z in 0..2 {
        let mut rows = [[0; 2]; 3];
        for (x, row) in rows.iter_mut().enumerate() {
            let [low, own, high] = [columns[x][z], columns[x + 3][z], columns[x + 6][z]];
            *row = [
                low >> 12 & Y[0] | (own & Y[1]) << 4,
                own >> 4 & Y[1] | (high & Y[0]) << 12,
            ];
        }
        for y in 0..2 {
            let [low, own, high] = [rows[0][y], rows[1][y], rows[2][y]];
            windows[2 * y + 4 * z] = low >> 3 & X[0] | (own & X[1]) << 1;
            windows[1 + 2 * y + 4 * z] = own >> 1 & X[1] | (high & X[0]) << 3;
        }
    }
    windows
}
