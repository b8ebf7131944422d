//! How many pixels are drawn while the camera moves.

use std::time::Duration;

/// Time of a frame that is aimed at: 25 frames a second, so that 20 are kept when one takes longer.
const GOAL: Duration = Duration::from_millis(40);
/// The least share of the pixels along each side.
pub const LEAST: f64 = 0.25;
/// How much of a wanted increase is made at once, so that the resolution does not flicker.
const EASE: f64 = 0.3;

/// The resolution that the machine has time for.
#[derive(Debug, Clone, Copy)]
pub struct Pace {
    scale: f64,
}

impl Default for Pace {
    fn default() -> Self {
        Pace { scale: 1.0 }
    }
}

impl Pace {
    /// The size to draw for a window of this size.
    pub fn size(&self, window: [u32; 2]) -> [u32; 2] {
        window.map(|side| ((f64::from(side) * self.scale).round() as u32).clamp(1, side.max(1)))
    }

    /// Learns how long a frame took that was drawn in the size `drawn` for a window of this size.
    pub fn learn(&mut self, drawn: [u32; 2], window: [u32; 2], took: Duration) {
        let scale = f64::from(drawn[0]) / f64::from(window[0].max(1));
        let ratio = GOAL.as_secs_f64() / took.as_secs_f64().max(1e-4);
        // The time goes with the pixels, the square of the scale.
        let wanted = (scale * ratio.sqrt()).clamp(LEAST, 1.0);
        self.scale = match wanted < self.scale {
            true => wanted,
            false => self.scale + EASE * (wanted - self.scale),
        };
        if self.scale > 0.97 {
            self.scale = 1.0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WINDOW: [u32; 2] = [1000, 500];

    /// The size after many frames that take `fixed` and `by_pixel` for all pixels.
    fn settled(fixed: Duration, all_pixels: Duration) -> [u32; 2] {
        let mut pace = Pace::default();
        for _ in 0..100 {
            let size = pace.size(WINDOW);
            let share = f64::from(size[0] * size[1]) / f64::from(WINDOW[0] * WINDOW[1]);
            pace.learn(size, WINDOW, fixed + all_pixels.mul_f64(share));
        }
        pace.size(WINDOW)
    }

    #[test]
    fn a_machine_that_keeps_up_draws_every_pixel() {
        assert_eq!(settled(Duration::from_millis(2), Duration::from_millis(20)), WINDOW);
    }

    #[test]
    fn a_slow_machine_settles_where_frames_take_as_long_as_they_may() {
        let all = Duration::from_millis(160);
        let [width, height] = settled(Duration::ZERO, all);
        let took = all.mul_f64(f64::from(width * height) / 5e5);
        assert!(took.abs_diff(GOAL) < Duration::from_millis(2), "{took:?}");
    }

    #[test]
    fn no_machine_is_so_slow_that_nothing_can_be_seen() {
        assert_eq!(settled(Duration::from_secs(1), Duration::from_secs(9)), [250, 125]);
        assert_eq!(Pace { scale: LEAST }.size([1, 1]), [1, 1]);
    }
}
