//! The points nearest to a point.

use std::ops::Range;

use rayon::prelude::*;

/// Points in a leaf of the tree, at most.
const LEAF: usize = 12;
/// Points that are searched for one after the other by a thread, and whose results are added up before others are
/// added.
pub const CHUNK: usize = 1 << 12;

/// The mean distance from a point to the nearest other; none for fewer than two points. Points at one place are 0
/// apart.
pub fn mean_nearest_distance(points: &[[f32; 3]]) -> Option<f64> {
    if points.len() < 2 {
        return None;
    }
    let tree = Tree::new(points);
    // Sums of fixed chunks, so that the result does not depend on the number of threads.
    let sums: Vec<f64> = tree
        .points
        .par_chunks(CHUNK)
        .map(|chunk| {
            let mut found = Vec::new();
            let nearest = chunk.iter().map(|point| {
                // The first is the point itself, or another at its place.
                tree.nearest(point.at, 2, &mut found);
                f64::from(found[1].square).sqrt()
            });
            nearest.sum()
        })
        .collect();
    Some(sums.iter().sum::<f64>() / points.len() as f64)
}

/// A balanced k-d tree: the median along x in the middle, in the halves beside it their medians along y, in theirs
/// those along z, and so on.
pub struct Tree {
    points: Vec<Point>,
}

/// A point of a tree.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// Where it is.
    pub at: [f32; 3],
    /// Its place among the points that the tree was made of.
    pub index: u32,
}

/// A point that was found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Found {
    /// The squared distance to it.
    pub square: f32,
    /// Where it is.
    pub at: [f32; 3],
}

impl Tree {
    /// A tree of these points.
    ///
    /// # Panics
    /// If there are more than 2³² of them.
    pub fn new(points: &[[f32; 3]]) -> Tree {
        let count = u32::try_from(points.len()).expect("at most 2³² points");
        let mut points: Vec<Point> = (0..count).zip(points).map(|(index, &at)| Point { at, index }).collect();
        arrange(&mut points, 0);
        Tree { points }
    }

    /// All points, those that are near each other mostly near each other.
    pub fn points(&self) -> &[Point] {
        &self.points
    }

    /// Makes `found` the `count` points nearest to a place (all, if there are fewer), the nearest first.
    pub fn nearest(&self, at: [f32; 3], count: usize, found: &mut Vec<Found>) {
        found.clear();
        if count > 0 {
            self.search(0..self.points.len(), 0, at, count, found);
        }
    }

    fn search(&self, range: Range<usize>, depth: usize, at: [f32; 3], count: usize, found: &mut Vec<Found>) {
        if range.len() <= LEAF {
            for point in &self.points[range] {
                insert(point, at, count, found);
            }
            return;
        }
        let (axis, middle) = (depth % 3, range.start + range.len() / 2);
        insert(&self.points[middle], at, count, found);
        let (low, high) = (range.start..middle, middle + 1..range.end);
        let beyond = at[axis] - self.points[middle].at[axis];
        // Which half a point is in does not follow from its coordinate where that equals the median's: both are
        // searched then.
        let (near, far) = if beyond < 0.0 { (low, high) } else { (high, low) };
        self.search(near, depth + 1, at, count, found);
        if found.len() < count || beyond * beyond < found[found.len() - 1].square {
            self.search(far, depth + 1, at, count, found);
        }
    }
}

/// Puts a point in its place among those found, if it is one of the `count` nearest.
fn insert(point: &Point, at: [f32; 3], count: usize, found: &mut Vec<Found>) {
    let square: f32 = (0..3).map(|k| (point.at[k] - at[k]).powi(2)).sum();
    if found.len() == count {
        if square >= found[count - 1].square {
            return;
        }
        found.pop();
    }
    let mut place = found.len();
    while place > 0 && found[place - 1].square > square {
        place -= 1;
    }
    found.insert(place, Found { square, at: point.at });
}

fn arrange(points: &mut [Point], depth: usize) {
    if points.len() <= LEAF {
        return;
    }
    let (axis, middle) = (depth % 3, points.len() / 2);
    points.select_nth_unstable_by(middle, |a, b| a.at[axis].total_cmp(&b.at[axis]));
    let (low, high) = points.split_at_mut(middle);
    rayon::join(|| arrange(low, depth + 1), || arrange(&mut high[1..], depth + 1));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::procedural::rng::Rng;

    fn random(count: usize) -> Vec<[f32; 3]> {
        let mut rng = Rng::new(4);
        (0..count).map(|_| (rng.direction() * rng.unit()).to_array()).collect()
    }

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
        let points = random(700);
        let tree = Tree::new(&points);
        let mut sum = 0.0;
        for p in &points {
            let of = |q: &[f32; 3]| -> f32 { (0..3).map(|k| (p[k] - q[k]).powi(2)).sum() };
            let mut expected: Vec<f32> = points.iter().map(of).collect();
            expected.sort_by(f32::total_cmp);
            let mut found = Vec::new();
            tree.nearest(*p, 40, &mut found);
            let squares: Vec<f32> = found.iter().map(|f| f.square).collect();
            assert_eq!(squares, expected[..40]);
            assert!(found.iter().all(|f| of(&f.at) == f.square));
            sum += f64::from(expected[1]).sqrt();
        }
        let (found, expected) = (mean_nearest_distance(&points).unwrap(), sum / 700.0);
        assert!((found - expected).abs() < 1e-9, "{found} {expected}");
    }

    #[test]
    fn the_tree_holds_every_point_with_its_index() {
        let points = random(100);
        let tree = Tree::new(&points);
        let mut indices: Vec<u32> = tree.points().iter().map(|p| p.index).collect();
        indices.sort_unstable();
        assert!(indices.iter().copied().eq(0..100));
        for point in tree.points() {
            assert_eq!(points[point.index as usize], point.at);
        }
    }

    #[test]
    fn fewer_points_than_are_asked_for_are_all_found() {
        let mut found = Vec::new();
        Tree::new(&random(3)).nearest([0.0; 3], 40, &mut found);
        assert_eq!(found.len(), 3);
        Tree::new(&[]).nearest([0.0; 3], 40, &mut found);
        assert_eq!(found.len(), 0);
    }

    #[test]
    fn one_point_alone_has_no_neighbour_and_twins_are_0_apart() {
        assert_eq!(mean_nearest_distance(&[[1.0; 3]]), None);
        assert_eq!(mean_nearest_distance(&[[1.0; 3]; 2]), Some(0.0));
    }
}
