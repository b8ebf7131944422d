//! Gaussians as they should be.

use std::time::Instant;

use super::MeasuredInput;
use b2p::Result;
use b2p::cloud::ColouredVoxels;
use b2p::container::{Header, Stream};
use b2p::gaussians::Heads;
use b2p::gaussians::{Frame, Gaussians};
use b2p::latents::LatentDecoder;
use b2p::latents::network::Model;
use b2p::latents::{ColourContexts, ColourFilter, ColourResidual, activate};
use b2p::log::Log;

/// The Gaussians that the best heads have for a level, generated in double precision; and how many milliseconds that
/// took.
///
/// # Errors
/// Those of [`LatentDecoder::exact`] and [`Model::generate_in_double`].
pub fn in_double(subject: &MeasuredInput<'_>, model: &Model, level: u8) -> Result<(Gaussians, f64)> {
    let header = Header::parse(subject.stream, subject.limits)?;
    let decoder = LatentDecoder::new(model).with_limits(subject.limits.clone());
    let exact = decoder.exact(subject.stream, level, &Log::default())?;
    let role = usize::from(level.saturating_sub(header.base));
    let map = exact.octree.kernel_map(level);
    let start = Instant::now();
    let raw = model.generate_in_double(Heads::Best, role, &exact.features, &map)?;
    let took = start.elapsed().as_secs_f64() * 1e3;
    let head = model.shape().head(role, Heads::Best);
    let children = head.map_or(1, |head| head.children);
    let (voxels, frame) = (exact.octree.level(level), decoder.frame(subject.stream)?);
    let mut gaussians = activate(&raw, voxels, children, model.shape(), frame);
    let stream = Stream::parse(subject.stream, subject.limits)?;
    let Some(said) = stream.levels().get(role) else {
        return Ok((gaussians, took));
    };
    if let Some(filter) = said.filters[0] {
        let above = level.checked_sub(1).map(|up| exact.octree.kernel_map(up));
        let around = ColourContexts::of_level(&gaussians, &exact.octree, level, &map, above.as_ref());
        ColourFilter::parse(&filter, level)?.apply(&mut gaussians, &around);
    }
    let slice = header.slice_voxels as usize;
    let keys = voxels.keys();
    if let Some(residual) = ColourResidual::parse(&said.residual, keys, slice, level)? {
        residual.apply(&mut gaussians, keys);
    }
    Ok((gaussians, took))
}

/// A cloud as Gaussians: of each voxel one, opaque, round, with a standard deviation of half the voxel's width.
pub fn of_cloud(cloud: &ColouredVoxels) -> Gaussians {
    let count = cloud.voxels.len();
    let edge = 2.0 / (1u32 << cloud.voxels.depth()) as f32;
    let centre = |i| {
        let at: [u32; 3] = cloud.voxels.coordinate(i);
        at.map(|v| (v as f32 + 0.5) * edge - 1.0)
    };
    Gaussians {
        position: (0..count).map(centre).collect(),
        scale: vec![[edge / 2.0; 3]; count],
        rotation: vec![[1.0, 0.0, 0.0, 0.0]; count],
        opacity: vec![1.0; count],
        colour: (cloud.colours.iter().map(|c| c.map(|v| f32::from(v) / 255.0))).collect(),
        frame: Frame {
            bits: cloud.voxels.depth(),
            placement: cloud.placement,
        },
        ..Gaussians::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use b2p::geometry::{Voxels, morton};
    use b2p::limits::Limits;
    use b2p::placement::Placement;
    use b2p::renderer::camera::Camera;
    use b2p::renderer::{Background, render};

    #[test]
    fn a_cloud_is_seen_in_its_colours_where_it_is() {
        let cloud = ColouredVoxels {
            voxels: Voxels::new(2, vec![morton::encode([0, 0, 0]), morton::encode([3, 3, 3])]),
            colours: vec![[255, 0, 0], [0, 51, 255]],
            placement: Placement::VOXEL_GRID,
        };
        let gaussians = of_cloud(&cloud);
        gaussians.check_lengths().unwrap();
        assert_eq!(gaussians.position, [[-0.75; 3], [0.75; 3]]);
        assert_eq!(gaussians.colour[1], [0.0, 0.2, 1.0]);
        let camera = Camera::orbit(0.0, 0.0, 4.0, 45.0, 64, 64).unwrap();
        let limits = Limits::default();
        let (image, _) = render(&gaussians, &camera, Background::WHITE, &limits).unwrap();
        let seen = |colour: [f32; 3]| {
            let apart = |pixel: &&[f32; 4]| (0..3).all(|k| (pixel[k] - colour[k]).abs() < 0.1);
            image.pixels.iter().filter(apart).count()
        };
        assert!(seen([1.0, 0.0, 0.0]) > 10 && seen([0.0, 0.2, 1.0]) > 10);
        assert!(seen([1.0; 3]) > 32 * 64);
    }
}
