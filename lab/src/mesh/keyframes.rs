//! The curves of a glTF animation: key frames and how values go between them.

use glam::{DQuat, DVec4};
use gltf::animation::Interpolation;

/// One property of one node over time: `width` values a key.
#[derive(Debug, Clone)]
pub(super) struct Curve {
    times: Vec<f64>,
    /// A row of `width` values for each key; with cubic splines three rows: tangent in, value, tangent out.
    values: Vec<f64>,
    width: usize,
    interpolation: Interpolation,
}

impl Curve {
    /// # Errors
    /// If there is no key, times do not rise, or the number of values is not the keys'.
    pub fn new(times: Vec<f64>, values: Vec<f64>, width: usize, interpolation: Interpolation) -> Result<Self, String> {
        if times.is_empty() {
            return Err("an animation has no key frames".into());
        }
        if times.windows(2).any(|t| t[0] >= t[1]) {
            return Err("the times of an animation's key frames do not rise".into());
        }
        let rows = if interpolation == Interpolation::CubicSpline {
            3
        } else {
            1
        };
        let expected = times.len().checked_mul(rows * width);
        if expected != Some(values.len()) {
            let (keys, have) = (times.len(), values.len());
            return Err(format!(
                "an animation has {have} values for {keys} key frames of {rows} x {width}"
            ));
        }
        Ok(Curve {
            times,
            values,
            width,
            interpolation,
        })
    }

    /// First and last key's time in seconds.
    pub fn span(&self) -> [f64; 2] {
        [self.times[0], self.times[self.times.len() - 1]]
    }

    /// The values at a time. Before the first key and after the last the curve is constant.
    pub fn at(&self, time: f64) -> Vec<f64> {
        let (from, to, share, gap) = self.between(time);
        match self.interpolation {
            Interpolation::Step => self.value(from).to_vec(),
            Interpolation::Linear => {
                let pairs = self.value(from).iter().zip(self.value(to));
                pairs.map(|(a, b)| a + share * (b - a)).collect()
            }
            Interpolation::CubicSpline => self.spline(from, to, share, gap),
        }
    }

    /// The rotation at a time, for curves of four values.
    pub fn rotation_at(&self, time: f64) -> DQuat {
        let quaternion = |v: &[f64]| {
            let v = DVec4::new(v[0], v[1], v[2], v[3]);
            DQuat::from_vec4(v.try_normalize().unwrap_or(DVec4::W))
        };
        let (from, to, share, _) = self.between(time);
        match self.interpolation {
            // `slerp` takes the shorter way, as glTF says.
            Interpolation::Linear => quaternion(self.value(from)).slerp(quaternion(self.value(to)), share),
            Interpolation::Step | Interpolation::CubicSpline => quaternion(&self.at(time)),
        }
    }

    /// The keys around a time, how far it is from the first to the second (0 to 1), and the seconds between them.
    fn between(&self, time: f64) -> (usize, usize, f64, f64) {
        let after = self.times.partition_point(|&t| t <= time);
        if after == 0 || after == self.times.len() {
            let key = after.saturating_sub(1);
            return (key, key, 0.0, 0.0);
        }
        let gap = self.times[after] - self.times[after - 1];
        (after - 1, after, (time - self.times[after - 1]) / gap, gap)
    }

    fn value(&self, key: usize) -> &[f64] {
        match self.interpolation {
            Interpolation::CubicSpline => self.row(3 * key + 1),
            _ => self.row(key),
        }
    }

    fn row(&self, row: usize) -> &[f64] {
        &self.values[row * self.width..(row + 1) * self.width]
    }

    /// The Hermite spline of glTF 2.0, appendix C.5.
    fn spline(&self, from: usize, to: usize, t: f64, gap: f64) -> Vec<f64> {
        if from == to {
            return self.value(from).to_vec();
        }
        let (out, into) = (self.row(3 * from + 2), self.row(3 * to));
        let (t2, t3) = (t * t, t * t * t);
        let hermite = |k: usize| {
            (2.0 * t3 - 3.0 * t2 + 1.0) * self.value(from)[k]
                + gap * (t3 - 2.0 * t2 + t) * out[k]
                + (3.0 * t2 - 2.0 * t3) * self.value(to)[k]
                + gap * (t3 - t2) * into[k]
        };
        (0..self.width).map(hermite).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn curve(values: &[f64], interpolation: Interpolation) -> Curve {
        Curve::new(vec![1.0, 3.0], values.to_vec(), 1, interpolation).unwrap()
    }

    #[test]
    fn steps_hold_lines_rise_and_both_stay_outside_of_the_keys() {
        let (step, line) = (
            curve(&[2.0, 6.0], Interpolation::Step),
            curve(&[2.0, 6.0], Interpolation::Linear),
        );
        let times = [0.0, 1.0, 2.5, 3.0, 9.0];
        assert_eq!(times.map(|t| step.at(t)[0]), [2.0, 2.0, 2.0, 6.0, 6.0]);
        assert_eq!(times.map(|t| line.at(t)[0]), [2.0, 2.0, 5.0, 6.0, 6.0]);
    }

    #[test]
    fn a_spline_meets_its_keys_and_tangents() {
        // The parabola x²: value 1 and slope 2 at 1, value 9 and slope 6 at 3.
        let spline = curve(&[0.0, 1.0, 2.0, 6.0, 9.0, 0.0], Interpolation::CubicSpline);
        for time in [1.0, 1.5, 2.0, 2.75, 3.0] {
            assert!((spline.at(time)[0] - time * time).abs() < 1e-12, "{time}");
        }
        assert_eq!([0.0, 4.0].map(|t| spline.at(t)[0]), [1.0, 9.0]);
    }

    #[test]
    fn a_rotation_turns_evenly_and_the_shorter_way() {
        let quarter = DQuat::from_rotation_z(1.5).to_array();
        let mut values = DQuat::IDENTITY.to_array().to_vec();
        values.extend(quarter.map(|x| -x));
        let turn = Curve::new(vec![0.0, 1.0], values, 4, Interpolation::Linear).unwrap();
        let third = turn.rotation_at(1.0 / 3.0);
        assert!(third.angle_between(DQuat::from_rotation_z(0.5)) < 1e-7, "{third}");
    }

    #[test]
    fn keys_that_do_not_fit_are_refused() {
        let new = |times: &[f64], values: usize| {
            Curve::new(times.to_vec(), vec![0.0; values], 3, Interpolation::Linear).map(|_| ())
        };
        assert!(new(&[], 0).is_err());
        assert!(new(&[1.0, 1.0], 6).unwrap_err().contains("rise"));
        assert!(new(&[1.0, 2.0], 5).unwrap_err().contains("5 values"));
    }
}
