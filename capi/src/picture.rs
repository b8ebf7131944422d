//! Pictures into the caller's memory.

use std::ffi::c_char;

use b2p::renderer::{Background, render};

use crate::boundary::{Fault, Status, borrowed, changed, guard};
use crate::decoding::Gaussians;
use crate::model::Limits;

/// A camera on a sphere around the cube's centre, looking at it, and what is behind the Gaussians.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct Camera {
    /// Degrees around the vertical axis.
    pub azimuth: f64,
    /// Degrees above the horizon.
    pub elevation: f64,
    /// From the cube's centre; the cube reaches from -1 to 1.
    pub distance: f64,
    /// Horizontal field of view in degrees.
    pub fov: f64,
    /// Pixels side by side.
    pub width: u32,
    /// Rows of pixels.
    pub height: u32,
    /// Red, green, blue of the background in [0, 1], if it is not transparent.
    pub background: [f32; 3],
    /// Whether the background lets light through.
    pub transparent: bool,
}

/// Draws Gaussians into `pixels`: 4 * width * height bytes of red, green, blue, alpha, premultiplied, row by row from the top left.
/// `limits` may be NULL. Fails with USAGE if the camera is none or `length` is another, and with LIMIT.
///
/// # Safety
/// `gaussians` are Gaussians; `camera` is a camera; `limits` is NULL or limits; `pixels` leads to `length` writable bytes; `message` is
/// NULL or leads to `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_render(
    gaussians: *const Gaussians,
    camera: *const Camera,
    limits: *const Limits,
    pixels: *mut u8,
    length: usize,
    message: *mut c_char,
    size: usize,
) -> Status {
    let run = || {
        // SAFETY: the caller vouches for all three.
        let (Gaussians(gaussians), view, limits) = unsafe {
            let gaussians = borrowed(gaussians, "gaussians")?;
            (gaussians, borrowed(camera, "camera")?, limits.as_ref())
        };
        let limits = limits.map_or_else(b2p::Limits::default, |limits| (*limits).into());
        let needed = 4 * u64::from(view.width) * u64::from(view.height);
        if needed != length as u64 {
            let text = format!("the picture has {needed} bytes, the buffer {length}");
            return Err(Fault::usage(text));
        }
        let camera = b2p::renderer::camera::Camera::orbit(
            view.azimuth,
            view.elevation,
            view.distance,
            view.fov,
            view.width,
            view.height,
        )?;
        let background = match view.transparent {
            true => Background::Transparent,
            false => Background::Colour(view.background),
        };
        let (image, _) = render(gaussians, &camera, background, &limits)?;
        let picture = image.to_pixmap()?;
        // SAFETY: the caller vouches for `length` writable bytes, which are as many as the picture has; nothing else refers to them.
        unsafe {
            changed(pixels, "pixels")?;
            std::ptr::copy_nonoverlapping(picture.data().as_ptr(), pixels, length);
        }
        Ok(())
    };
    // SAFETY: the caller vouches for `message`.
    unsafe { guard(message, size, run) }
}
