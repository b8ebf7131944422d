//! The stages of one picture: plan, projection, bins by tile, blending.

use std::sync::Mutex;
use std::time::{Duration, Instant};

use b2p_kernels::splat::{Crossing, Loop, Scene};
use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::gaussians::Gaussians;
use crate::limits::Limits;
use crate::renderer::Renderer;
use crate::renderer::camera::Camera;
use crate::renderer::canvas::{Canvas, Contents, Output, Scratch};
use crate::renderer::effects::{EffectMode, EffectSet};
use crate::renderer::options::{Background, OutputOptions};
use crate::renderer::projection::{Ellipse, Ellipses, Projected, ProjectionOptions};
use crate::renderer::shade::{self, Channel};
use crate::renderer::stats::{Stats, Times};
use crate::renderer::tiles::{Count, Grid, TILE, TileBand};

impl Renderer {
    pub(super) fn frame<O: Output>(
        &mut self,
        gaussians: &Gaussians,
        camera: &Camera,
        options: OutputOptions,
        output: &O,
        limits: &Limits,
        pixels: &mut Vec<O::Pixel>,
    ) -> Result<Stats> {
        let mut plan = self.plan::<O>(gaussians, camera, &options, limits)?;
        let (mut times, mut laps) = (Times::default(), Laps(Instant::now()));
        let seen = self.project(gaussians, camera, options.channel, &mut plan, limits)?;
        times.project = laps.lap();
        let pairs = self.bins.plan(plan.grid, &mut self.counts, plan.bytes, limits)?;
        times.bin = laps.lap();
        if pixels.capacity() < plan.pixels {
            // What is outgrown goes first, and zeros come as tiles are drawn, from the threads that draw them.
            *pixels = Vec::new();
            *pixels = bytemuck::try_zeroed_vec(plan.pixels).map_err(|()| Error::OutOfMemory {
                what: "the pixels of the picture",
                bytes: (plan.pixels * size_of::<O::Pixel>()) as u64,
            })?;
        }
        pixels.resize(plan.pixels, bytemuck::Zeroable::zeroed());
        let canvas = Canvas {
            grid: plan.grid,
            window: camera.window(),
            shrink: plan.effects.supersample,
            background: options.background,
        };
        self.draw_parts(&plan, &canvas, output, pixels, &mut times, &mut laps)?;
        let samples = u64::from(plan.effects.supersample).pow(2);
        Ok(Stats {
            touched: self.take_touched() / samples,
            visible: self.ellipses.len() as u64,
            dropped: seen.dropped,
            crossing: seen.crossing,
            pairs,
            effects: plan.effects,
            times,
        })
    }

    /// Checks all that is asked for, and derives how to draw it.
    fn plan<O: Output>(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        options: &OutputOptions,
        limits: &Limits,
    ) -> Result<Plan> {
        camera.check()?;
        gaussians.check_lengths()?;
        if let Background::Colour(c) = options.background
            && !c.iter().all(|x| x.is_finite())
        {
            let what = format!("the background {c:?} is not a colour");
            return Err(Error::Usage(what));
        }
        let [width, height] = camera.size();
        let count = u64::from(width) * u64::from(height);
        limits.check_pixels("pixels of the picture", count)?;
        let mut effects = self.effects.derive(gaussians, camera);
        if O::LOOP.is_some() {
            effects.supersample = 1;
            effects.order = false;
        }
        let fine = camera.magnified(effects.supersample);
        let grid = Grid::new(fine.window());
        let shaded = effects.shades() || options.channel != Channel::Colour;
        let each = Ellipses::BYTES
            + Count::BYTES
            + u64::from(shaded) * size_of::<[f32; 3]>() as u64
            + u64::from(effects.order) * size_of::<[f32; 2]>() as u64;
        let bytes = count * size_of::<O::Pixel>() as u64
            + gaussians.len() as u64 * each
            + grid.bytes(Ellipses::runs_of(gaussians.len()));
        limits.check_bytes(BYTES, bytes)?;
        Ok(Plan {
            effects,
            fine,
            grid,
            shaded,
            pixels: count as usize,
            bytes,
        })
    }

    /// Finds the ellipses and counts them by tile. Completes the plan: whether any cross the near plane, and their
    /// bytes.
    fn project(
        &mut self,
        gaussians: &Gaussians,
        camera: &Camera,
        channel: Channel,
        plan: &mut Plan,
        limits: &Limits,
    ) -> Result<Projected> {
        if plan.shaded {
            shade::fill(gaussians, camera, channel, &plan.effects, &mut self.shades);
        }
        let projection = ProjectionOptions {
            isa: self.isa,
            compensated: plan.effects.antialias,
            floor: self.quality.floor(),
            ray_space: self.effects.near != EffectMode::Off,
            slopes: plan.effects.order,
            colours: plan.shaded.then_some(&self.shades),
        };
        let grid = plan.grid;
        let start = |count: &mut Count, length| count.start(grid, length);
        let look = |count: &mut Count, ellipses: &[Ellipse]| count.count(grid, ellipses);
        let counts = &mut self.counts;
        let seen = self
            .ellipses
            .project(gaussians, &plan.fine, projection, counts, start, look)?;
        plan.effects.near = projection.ray_space && seen.crossing > 0;
        if plan.effects.near {
            plan.bytes += seen.crossing * size_of::<Crossing>() as u64;
        }
        limits.check_bytes(BYTES, plan.bytes)?;
        self.ellipses.fill_effect_data(gaussians, &plan.fine, projection);
        Ok(seen)
    }

    /// Draws the picture in as many parts as its limits call for.
    fn draw_parts<O: Output>(
        &mut self,
        plan: &Plan,
        canvas: &Canvas,
        output: &O,
        pixels: &mut [O::Pixel],
        times: &mut Times,
        laps: &mut Laps,
    ) -> Result<()> {
        self.scratch.resize_with(rayon::current_num_threads(), Mutex::default);
        let what = O::LOOP.unwrap_or(match (plan.effects.order, plan.effects.near) {
            (true, _) => Loop::Order,
            (_, true) => Loop::RaySpace,
            _ => Loop::Plain,
        });
        let mut part = self.bins.next(None);
        while let Some(now) = part {
            self.bins.fill(now.clone(), &self.ellipses, &mut self.counts)?;
            times.bin += laps.lap();
            let [sorting, blending] = self.draw_part(&now, canvas, self.quality.floor(), what, output, pixels);
            let drawn = laps.lap();
            let share = sorting.as_secs_f64() / (sorting + blending).as_secs_f64().max(1e-9);
            times.sort += drawn.mul_f64(share);
            times.blend += drawn.mul_f64(1.0 - share);
            part = self.bins.next(Some(&now));
        }
        Ok(())
    }

    /// Blocks that all threads have touched since this was asked last.
    fn take_touched(&mut self) -> u64 {
        let touched = |scratch: &mut Mutex<Scratch>| {
            let scratch = scratch.get_mut().unwrap_or_else(|e| e.into_inner());
            std::mem::take(&mut scratch.touched)
        };
        self.scratch.iter_mut().map(touched).sum()
    }

    /// Draws a part of the picture; returns the threads' time for sorting and for the pixels.
    fn draw_part<O: Output>(
        &self,
        part: &TileBand,
        canvas: &Canvas,
        floor: f32,
        what: Loop,
        output: &O,
        pixels: &mut [O::Pixel],
    ) -> [Duration; 2] {
        let contents = Contents {
            isa: self.isa,
            bins: &self.bins,
            scene: Scene {
                all: self.ellipses.all(),
                crossing: self.ellipses.crossing(),
                slopes: self.ellipses.slopes(),
            },
            floor,
            what,
        };
        let width = canvas.width();
        let start = canvas.rows(part.rows.start).start * width;
        let end = canvas.rows(part.rows.end - 1).end * width;
        // A window may begin within a row of tiles.
        let first = canvas.rows(part.rows.start).len() * width;
        let (first, rest) = pixels[start..end].split_at_mut(first);
        rayon::iter::once(first)
            .chain(rest.par_chunks_mut((TILE / canvas.shrink) as usize * width))
            .zip(part.rows.clone())
            .with_max_len(1)
            .for_each(|(band, row)| {
                let thread = rayon::current_thread_index().unwrap_or(0);
                // Only this thread uses this scratch, and a panic would have ended the drawing.
                let mut scratch = self.scratch[thread].lock().unwrap_or_else(|e| e.into_inner());
                for column in part.columns.clone() {
                    scratch.draw([column, row], canvas, &contents, output, band);
                }
            });
        self.scratch.iter().fold(Default::default(), |sum, scratch| {
            let scratch = &mut *scratch.lock().unwrap_or_else(|e| e.into_inner());
            let times = [&mut scratch.sorting, &mut scratch.blending].map(std::mem::take);
            [sum[0] + times[0], sum[1] + times[1]]
        })
    }
}

/// What errors call the memory that a picture takes.
const BYTES: &str = "bytes to draw the picture";

/// How a picture is drawn.
struct Plan {
    effects: EffectSet,
    /// The camera, with as many pixels as there are samples.
    fine: Camera,
    grid: Grid,
    /// Whether the Gaussians' colours are not what is drawn.
    shaded: bool,
    pixels: usize,
    /// Bytes of memory that drawing takes, but for what lists of tiles take.
    bytes: u64,
}

/// A clock that tells the time since it was asked last.
struct Laps(Instant);

impl Laps {
    fn lap(&mut self) -> Duration {
        std::mem::replace(&mut self.0, Instant::now()).elapsed()
    }
}
