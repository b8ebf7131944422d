//! Draws pictures on a thread of its own, so that a window answers while it waits for one.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, Instant};

use b2p::renderer::camera::Camera;
use b2p::renderer::{Background, Channel, Image, Renderer, Stats};
use b2p::{Gaussians, Isa, Limits};
use rayon::ThreadPool;
use rayon::prelude::*;

use super::clip;
use crate::{Failure, Result, manners};

/// Side of the squares, in pixels, that show where a picture is transparent, and how light they are.
const SQUARE: usize = 16;
const SQUARES: [f32; 2] = [0.6, 0.8];

/// A picture to draw.
#[derive(Debug, Clone)]
pub struct Order {
    pub gaussians: Arc<Gaussians>,
    /// Its picture may be smaller than the window.
    pub camera: Camera,
    /// What is outside of this box is left out.
    pub clip: Option<[[f32; 3]; 2]>,
    pub background: Background,
    pub to: Destination,
}

/// Where a picture goes.
#[derive(Debug, Clone, PartialEq)]
pub enum Destination {
    /// A window of this size, where the camera moves or not.
    Window { size: [u32; 2], moving: bool },
    /// A PNG file.
    File(PathBuf),
}

/// A picture of a window's size.
#[derive(Debug)]
pub struct Picture {
    /// Row by row, 0x00RRGGBB.
    pub pixels: Vec<u32>,
    pub size: [u32; 2],
    /// The size that it was drawn in.
    pub drawn: [u32; 2],
    pub moving: bool,
    pub stats: Stats,
    /// Wall time of all of it.
    pub took: Duration,
}

/// What became of an order.
#[derive(Debug)]
pub enum Painted {
    Picture(Picture),
    Saved(PathBuf),
    Failed(String),
}

/// A thread that draws, one picture after the other.
pub struct Painter {
    orders: Sender<Order>,
}

impl Painter {
    /// Starts the thread, which calls `tell` with every picture. Its work runs in a pool of its own: what decodes does
    /// not hold it up.
    pub fn start(isa: Isa, limits: Limits, tell: impl Fn(Painted) + Send + 'static) -> Result<Painter> {
        let threads = rayon::current_num_threads();
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        let cannot = |e: &dyn std::fmt::Display| Failure(format!("cannot start threads to draw: {e}"));
        let pool = pool.map_err(|e| cannot(&e))?;
        let (orders, received) = channel();
        let easel = Easel::new(Renderer::new().with_isa(isa), limits, pool);
        let started = std::thread::Builder::new().spawn(move || easel.run(&received, tell));
        started.map_err(|e| cannot(&e))?;
        Ok(Painter { orders })
    }

    /// Asks for a picture.
    pub fn paint(&self, order: Order) {
        // If the thread has ended, so will the program.
        let _ = self.orders.send(order);
    }
}

/// What the thread draws with.
struct Easel {
    renderer: Renderer,
    limits: Limits,
    pool: ThreadPool,
    image: Image,
    /// The part of the Gaussians that is inside a box, and of which it was taken.
    clipped: Option<Clipped>,
}

struct Clipped {
    of: Arc<Gaussians>,
    corners: [[f32; 3]; 2],
    part: Arc<Gaussians>,
}

impl Easel {
    fn new(renderer: Renderer, limits: Limits, pool: ThreadPool) -> Self {
        Easel {
            renderer,
            limits,
            pool,
            image: Image::default(),
            clipped: None,
        }
    }

    fn run(mut self, orders: &Receiver<Order>, tell: impl Fn(Painted)) {
        for order in orders {
            tell(
                self.paint(&order)
                    .unwrap_or_else(|Failure(message)| Painted::Failed(message)),
            );
        }
    }

    fn paint(&mut self, order: &Order) -> Result<Painted> {
        let start = Instant::now();
        let gaussians = self.part(order);
        let Easel {
            renderer,
            limits,
            pool,
            image,
            ..
        } = self;
        let (camera, background) = (&order.camera, order.background);
        let stats = pool.install(|| {
            let colour = Channel::Colour;
            renderer.draw_into(&gaussians, camera, colour, background, limits, image)
        })?;
        let (size, moving) = match &order.to {
            Destination::File(path) => {
                manners::write(path, |w| image.write_png(w, path))?;
                return Ok(Painted::Saved(path.clone()));
            }
            Destination::Window { size, moving } => (*size, *moving),
        };
        let mut pixels = vec![0; size[0] as usize * size[1] as usize];
        pool.install(|| fill(image, size, &mut pixels));
        Ok(Painted::Picture(Picture {
            pixels,
            size,
            drawn: [image.width, image.height],
            moving,
            stats,
            took: start.elapsed(),
        }))
    }

    /// The Gaussians inside the box.
    fn part(&mut self, order: &Order) -> Arc<Gaussians> {
        let Some(corners) = order.clip else {
            self.clipped = None;
            return order.gaussians.clone();
        };
        let same = |clipped: &&Clipped| Arc::ptr_eq(&clipped.of, &order.gaussians) && clipped.corners == corners;
        if let Some(clipped) = self.clipped.as_ref().filter(same) {
            return clipped.part.clone();
        }
        let part = Arc::new(clip::inside(&order.gaussians, corners));
        self.clipped = Some(Clipped {
            of: order.gaussians.clone(),
            corners,
            part: part.clone(),
        });
        part
    }
}

/// Fills a window with a picture, which may have another size: bilinear, squares behind what is transparent.
fn fill(image: &Image, [width, height]: [u32; 2], pixels: &mut [u32]) {
    let across = axis(image.width, width);
    let down = axis(image.height, height);
    let stride = image.width as usize;
    let same = (image.width, image.height) == (width, height);
    let rows = pixels.par_chunks_exact_mut(width.max(1) as usize).zip(&down);
    rows.enumerate().for_each(|(y, (row, &(y0, y1, v)))| {
        let [upper, lower] = [y0, y1].map(|y| &image.pixels[y * stride..][..stride]);
        for (x, (pixel, &(x0, x1, u))) in row.iter_mut().zip(&across).enumerate() {
            let colour = match same {
                true => upper[x],
                false => std::array::from_fn(|k| {
                    let above = upper[x0][k] + u * (upper[x1][k] - upper[x0][k]);
                    let below = lower[x0][k] + u * (lower[x1][k] - lower[x0][k]);
                    above + v * (below - above)
                }),
            };
            *pixel = packed(colour, x, y);
        }
    });
}

/// Shows a picture of another size until the right one is there.
pub fn stretch(picture: &Picture, [width, height]: [u32; 2], pixels: &mut [u32]) {
    let [columns, rows] = picture.size.map(u64::from);
    for (y, row) in pixels.chunks_exact_mut(width as usize).enumerate() {
        let from = (y as u64 * rows / u64::from(height)) * columns;
        for (x, pixel) in row.iter_mut().enumerate() {
            *pixel = picture.pixels[(from + x as u64 * columns / u64::from(width)) as usize];
        }
    }
}

/// For each of `to` pixels the two of `from` that it is between, and the weight of the second.
fn axis(from: u32, to: u32) -> Vec<(usize, usize, f32)> {
    let last = from.saturating_sub(1) as usize;
    let place = |i: u32| {
        let at = ((f64::from(i) + 0.5) * f64::from(from) / f64::from(to) - 0.5).clamp(0.0, last as f64);
        let first = at.floor();
        (first as usize, (first as usize + 1).min(last), (at - first) as f32)
    };
    (0..to).map(place).collect()
}

/// Eight bits a channel; what is behind shows where a colour is transparent.
fn packed([r, g, b, a]: [f32; 4], x: usize, y: usize) -> u32 {
    let behind = (1.0 - a.clamp(0.0, 1.0)) * SQUARES[(x / SQUARE + y / SQUARE) % 2];
    let [r, g, b] = [r, g, b].map(|c| ((c + behind).clamp(0.0, 1.0) * 255.0 + 0.5) as u32);
    r << 16 | g << 8 | b
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(width: u32, height: u32, colour: impl Fn(u32, u32) -> [f32; 4]) -> Image {
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        Image {
            width,
            height,
            pixels: pixels.map(|(x, y)| colour(x, y)).collect(),
        }
    }

    fn filled(image: &Image, size: [u32; 2]) -> Vec<u32> {
        let mut pixels = vec![0; (size[0] * size[1]) as usize];
        fill(image, size, &mut pixels);
        pixels
    }

    #[test]
    fn a_picture_of_the_window_s_size_is_shown_as_a_file_of_it_would_be() {
        let image = image(5, 3, |x, y| [x as f32 / 4.0, y as f32 / 2.0, 0.3, 1.0]);
        let expected: Vec<u32> = image.to_ppm()[b"P6\n5 3\n255\n".len()..]
            .chunks(3)
            .map(|c| u32::from_be_bytes([0, c[0], c[1], c[2]]))
            .collect();
        assert_eq!(filled(&image, [5, 3]), expected);
    }

    #[test]
    fn a_smaller_picture_is_enlarged_without_being_shifted() {
        let ramp = image(8, 8, |x, y| [(x as f32 + 0.5) / 8.0, (y as f32 + 0.5) / 8.0, 0.0, 1.0]);
        let large = filled(&ramp, [32, 16]);
        for (y, row) in large.chunks(32).enumerate() {
            for (x, pixel) in row.iter().enumerate() {
                let expected = [(x as f32 + 0.5) / 32.0, (y as f32 + 0.5) / 16.0].map(|c| c.clamp(0.0625, 0.9375));
                let found = [pixel >> 16 & 255, pixel >> 8 & 255].map(|c| c as f32 / 255.0);
                assert!(
                    (0..2).all(|k| (found[k] - expected[k]).abs() < 0.003),
                    "{x}, {y}: {found:?}"
                );
            }
        }
    }

    #[test]
    fn squares_show_through_what_is_transparent() {
        let clear = image(40, 40, |_, _| [0.0; 4]);
        let pixels = filled(&clear, [40, 40]);
        assert_eq!(
            (pixels[0], pixels[16], pixels[16 * 40 + 16]),
            (0x999999, 0xcccccc, 0x999999)
        );
    }
}
