//! From numbers of pixels back to the Gaussians that they show: the transpose of drawing.

use b2p_kernels::Isa;
use b2p_kernels::splat::Loop;

use super::Renderer;
use super::canvas::{Canvas, Output, SIDE, Scratch};
use super::options::{Background, OutputOptions};
use super::projection::Bounds;
use crate::error::{Error, Result};
use crate::gaussians::Gaussians;
use crate::limits::Limits;
use crate::renderer::camera::Camera;

/// Numbers of the pixels of a window, row by row, and where their sums go.
struct Gathered<'a, F, const N: usize> {
    numbers: &'a [[f32; N]],
    window: Bounds,
    add: F,
}

impl<F: Fn(usize, [f32; N]) + Sync, const N: usize> Output for Gathered<'_, F, N> {
    type Pixel = ();

    const LOOP: Option<Loop> = Some(Loop::Shares);

    fn empty(&self, _: Background) {}

    fn look(&self, scratch: &mut Scratch, corner: [u32; 2]) {
        let Bounds { x0, y0, x1, y1 } = self.window;
        let width = (x1 - x0) as usize;
        for share in scratch.shares() {
            let [x, y] = [0, 1].map(|k| corner[k] + share.at[k]);
            // The columns and rows of the block that the window has.
            let columns = x.max(x0)..(x + SIDE as u32).min(x1);
            let rows = y.max(y0)..(y + SIDE as u32).min(y1);
            let mut sums = [0.0; N];
            for row in rows {
                let weights = &share.weights[(row - y) as usize * SIDE..];
                let numbers = &self.numbers[(row - y0) as usize * width..][..width];
                for column in columns.clone() {
                    let weight = weights[(column - x) as usize];
                    let numbers = numbers[(column - x0) as usize];
                    (0..N).for_each(|k| sums[k] += weight * numbers[k]);
                }
            }
            (self.add)(share.index as usize, sums);
        }
    }

    fn write(&self, _: &mut Scratch, _: Isa, _: &Canvas, _: Bounds, _: &mut [()], _: usize) {}
}

impl Renderer {
    /// The transpose of [`Renderer::mix_into`]. Calls `add` with the index of a Gaussian and the sum over some pixels of
    /// their `numbers`, given row by row, each times the share that the Gaussian has of the pixel; for a Gaussian as often
    /// as there are blocks of 4×4 pixels with it, in any order. One sample a pixel, whatever the effects.
    ///
    /// # Errors
    /// As [`Renderer::render_into`], and [`Error::Usage`] if the camera has not as many pixels.
    #[doc(hidden)]
    pub fn gather<const N: usize>(
        &mut self,
        gaussians: &Gaussians,
        camera: &Camera,
        numbers: &[[f32; N]],
        limits: &Limits,
        add: impl Fn(usize, [f32; N]) + Sync,
    ) -> Result<()> {
        let [width, height] = camera.size().map(|side| side as usize);
        if numbers.len() != width * height {
            let what = format!("{} numbers for {width} by {height} pixels", numbers.len());
            return Err(Error::Usage(what));
        }
        let window = camera.window();
        let output = Gathered { numbers, window, add };
        self.frame(
            gaussians,
            camera,
            OutputOptions::default(),
            &output,
            limits,
            &mut Vec::new(),
        )?;
        Ok(())
    }
}
