//! How far points are from each other.

use rayon::prelude::*;

/// Points in a leaf of the tree, at most.
const LEAF: usize = 12;

/// The mean distance from a point to the nearest other; none for fewer than two points. Points at one place are 0 apart.
pub fn mean_nearest_distance(points: &[[f32; 3]]) -> Option<f64> {
    if points.len() < 2 {
        return None;
    }
    let mut tree = points.to_vec();
    arrange(&mut tree, 0);
    // Sums of fixed chunks, so that the result does not depend on the number of threads.
    let sums: Vec<f64> = (0..tree.len())
        .collect::<Vec<_>>()
        .par_chunks(1 << 12)
        .map(|chunk| chunk.iter().map(|&i| nearest(&tree, i)).sum())
        .collect();
    Some(sums.iter().sum::<f64>() / points.len() as f64)
}

/// Makes `points` a balanced k-d tree: the median along x in the middle, in the halves beside it their medians along y, in theirs
/// those along z, and so on.
fn arrange(points: &mut [[f32; 3]], depth: usize) {
    if points.len() <= LEAF {
        return;
    }
    let (axis, middle) = (depth % 3, points.len() / 2);
    points.select_nth_unstable_by(middle, |a, b| a[axis].total_cmp(&b[axis]));
    let (low, high) = points.split_at_mut(middle);
    rayon::join(
        || arrange(low, depth + 1),
        || arrange(&mut high[1..], depth + 1),
    );
}

fn nearest(tree: &[[f32; 3]], own: usize) -> f64 {
    let mut square = f32::INFINITY;
    search(tree, 0..tree.len(), 0, own, &mut square);
    f64::from(square).sqrt()
}

/// Lowers `best` to the least squared distance from point `own` to another in `range`.
fn search(
    tree: &[[f32; 3]],
    range: std::ops::Range<usize>,
    depth: usize,
    own: usize,
    best: &mut f32,
) {
    let at = tree[own];
    let mut compare = |i: usize| {
        if i != own {
            let square: f32 = (0..3).map(|k| (tree[i][k] - at[k]).powi(2)).sum();
            *best = best.min(square);
        }
    };
    if range.len() <= LEAF {
        range.for_each(compare);
        return;
    }
    let (axis, middle) = (depth % 3, range.start + range.len() / 2);
    compare(middle);
    let (low, high) = (range.start..middle, middle + 1..range.end);
    let beyond = at[axis] - tree[middle][axis];
    // Which half a point is in does not follow from its coordinate where that equals the median's: both are searched then.
    let (near, far) = if beyond < 0.0 {
        (low, high)
    } else {
        (high, low)
    };
    search(tree, near, depth + 1, own, best);
    if beyond * beyond <= *best {
        search(tree, far, depth + 1, own, best);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::procedural::rng::Rng;

    #[test]
    fn the_points_of_a_lattice_are_its_spacing_apart() {
        let range = || (0..12).map(|i| i as f32 * 0.5);
        let points: Vec<[f32; 3]> = range()
            .flat_map(|x| range().flat_map(move |y| range().map(move |z| [x, y, z])))
            .collect();
        assert_eq!(mean_nearest_distance(&points), Some(0.5));
    }

    #[test]
    fn the_tree_finds_what_comparing_all_pairs_finds() {
        let mut rng = Rng::new(4);
        let points: Vec<[f32; 3]> = (0..700)
            .map(|_| (rng.direction() * rng.unit()).to_array())
            .collect();
        let of =
            |p: &[f32; 3], q: &[f32; 3]| -> f32 { (0..3).map(|k| (p[k] - q[k]).powi(2)).sum() };
        let brute = points.iter().enumerate().map(|(i, p)| {
            let others = points.iter().enumerate().filter(|(j, _)| *j != i);
            f64::from(others.map(|(_, q)| of(p, q)).fold(f32::INFINITY, f32::min)).sqrt()
        });
        let expected = brute.sum::<f64>() / points.len() as f64;
        let found = mean_nearest_distance(&points).unwrap();
        assert!((found - expected).abs() < 1e-9, "{found} {expected}");
    }

    #[test]
    fn one_point_alone_has_no_neighbour_and_twins_are_0_apart() {
        assert_eq!(mean_nearest_distance(&[[1.0; 3]]), None);
        assert_eq!(mean_nearest_distance(&[[1.0; 3]; 2]), Some(0.0));
    }
}
