//! Pictures as they should be, in both senses: computed without error from the stream, and of the object itself.

use std::time::Instant;

use super::double;
use super::{MeasuredInput, Origin};
use crate::raster::{self, View};
use crate::surface::Surface;
use b2p::cloud::ColouredVoxels;
use b2p::container::{Format, Header, Stream};
use b2p::gaussians::surfels::{PerVoxel, SurfelSelection, surfels};
use b2p::gaussians::{Frame, Gaussians, HeadSet, Heads};
use b2p::geometry::Octree;
use b2p::latents::LatentDecoder;
use b2p::latents::network::Model;
use b2p::latents::{ColourContexts, ColourFilter, ColourResidual, activate};
use b2p::log::Log;
use b2p::renderer::camera::Camera;
use b2p::renderer::{Image, Quality, Renderer};
use b2p::{Isa, Result};

/// Samples across and down a pixel of a mesh.
const SAMPLES: u32 = 4;

/// The Gaussians that the best heads have for a level, generated in double precision; and how many milliseconds that
/// took.
///
/// # Errors
/// Those of decoding, and of reading the model.
pub fn in_double(subject: &MeasuredInput<'_>, level: u8) -> Result<(Gaussians, f64)> {
    let header = Header::parse(subject.stream, subject.limits)?;
    match header.format {
        Format::Learned { .. } => latents_in_double(subject, &header, level),
        Format::Transform { .. } => heads_in_double(subject, &header, level),
    }
}

/// Of a stream of version 3. Surfels that the stream prefers to learned Gaussians stay as they are: they are exact.
fn heads_in_double(subject: &MeasuredInput<'_>, header: &Header, level: u8) -> Result<(Gaussians, f64)> {
    let decoder = subject.decoder()?.with_heads(HeadSet::Best).with_level(level);
    let decoding = decoder.whole(subject.stream)?;
    let drawn = decoding.gaussians()?;
    let count = if level + 1 < header.bits { 8 } else { 1 };
    let start = Instant::now();
    let made = decoding.with_heads_input(|input| {
        let made = double::generate(subject.model, (Heads::Best, count), &input, drawn.frame);
        let others = input
            .without
            .map_or(0, |without| without.iter().filter(|w| **w).count());
        made.map(|made| (made, others * if count == 8 { 4 } else { 1 }))
    });
    let took = start.elapsed().as_secs_f64() * 1e3;
    let Some((mut made, others)) = made.transpose()? else {
        return Ok((drawn, took));
    };
    let first = drawn.len() - others.min(drawn.len());
    made.position.extend(&drawn.position[first..]);
    made.scale.extend(&drawn.scale[first..]);
    made.rotation.extend(&drawn.rotation[first..]);
    made.opacity.extend(&drawn.opacity[first..]);
    made.colour.extend(&drawn.colour[first..]);
    Ok((made, took))
}

/// Of a stream of version 2.
fn latents_in_double(subject: &MeasuredInput<'_>, header: &Header, level: u8) -> Result<(Gaussians, f64)> {
    let model = Model::from_bytes(subject.model)?;
    let decoder = LatentDecoder::new(&model).with_limits(subject.limits.clone());
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

/// What the cameras see of the object that was coded, where that is at hand.
///
/// # Errors
/// Those of drawing the cloud.
pub fn of_origin(subject: &MeasuredInput<'_>, cameras: &[Camera]) -> Result<Option<Vec<Image>>> {
    match subject.origin {
        None => Ok(None),
        Some(Origin::Mesh(surface)) => {
            let frame = subject.decoder()?.frame(subject.stream)?;
            let to_cube = |p: [f32; 3]| frame.placement.to_cube(frame.bits, p.map(f64::from));
            let surface = surface.map(to_cube);
            Ok(Some(cameras.iter().map(|camera| of_mesh(&surface, camera)).collect()))
        }
        Some(Origin::Cloud(cloud)) => {
            let gaussians = of_cloud(cloud)?;
            let renderer = Renderer::new().with_quality(Quality::Exact);
            let mut renderer = renderer.with_limits(subject.limits.clone());
            let draw = |camera| renderer.render(&gaussians, camera);
            cameras.iter().map(draw).collect::<Result<_>>().map(Some)
        }
    }
}

/// A surface that is in the cube frame, on white.
pub fn of_mesh(surface: &Surface, camera: &Camera) -> Image {
    let rotation = camera.pose.matrix3.transpose();
    let view = View {
        rotation: [rotation.x_axis, rotation.y_axis, rotation.z_axis].map(|r| r.to_array()),
        translation: camera.pose.translation.to_array(),
        focal: [camera.fx, camera.fy],
        centre: [camera.cx, camera.cy],
        near: camera.near,
    };
    let [width, height] = camera.size();
    let drawn = raster::render(surface, &view, [width, height], SAMPLES, None);
    let opaque = drawn.over([1.0; 3]).into_iter();
    Image {
        width,
        height,
        pixels: opaque.map(|[r, g, b]| [r, g, b, 1.0]).collect(),
    }
}

/// A cloud as surfels, one of each voxel.
///
/// # Errors
/// Those of [`Octree::new`].
pub fn of_cloud(cloud: &ColouredVoxels) -> Result<Gaussians> {
    let octree = Octree::new(cloud.voxels.clone())?;
    let map = octree.sibling_map(cloud.voxels.depth());
    let frame = Frame {
        bits: cloud.voxels.depth(),
        placement: cloud.placement,
    };
    let (voxels, colours) = (&cloud.voxels, &cloud.colours);
    let choice = SurfelSelection::ALL;
    Ok(surfels(
        Isa::detect(),
        voxels,
        &map,
        colours,
        PerVoxel::One,
        choice,
        frame,
    ))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::mesh::Mesh;
    use crate::procedural::patch::Pattern;
    use crate::procedural::shapes;
    use b2p::geometry::{Voxels, morton};
    use b2p::metrics::pixels_apart;
    use b2p::placement::Placement;
    use glam::{Affine3A, Vec3};

    const RED: [f32; 3] = [1.0, 0.0, 0.0];

    /// A red ball, as a mesh and as a cloud.
    fn ball() -> (Surface, ColouredVoxels) {
        let place = Affine3A::from_translation(Vec3::new(0.3, 0.2, -0.1)) * Affine3A::from_scale(Vec3::splat(0.4));
        let paint: Pattern = Arc::new(|_| RED.into());
        let mesh = Mesh {
            parts: vec![shapes::sphere().placed(place).part(200.0, &paint, None)],
        };
        let (bits, side) = (6, 64u32);
        let on = |at: &[u32; 3]| {
            let p = at.map(|v| (v as f32 + 0.5) / 32.0 - 1.0);
            let squares = [p[0] - 0.3, p[1] - 0.2, p[2] + 0.1].map(|d| d * d);
            (squares.iter().sum::<f32>().sqrt() - 0.4).abs() < 0.02
        };
        let all = (0..side.pow(3)).map(|i| [i % side, i / side % side, i / side / side]);
        let voxels = Voxels::new(bits, all.filter(on).map(morton::encode).collect());
        let cloud = ColouredVoxels {
            colours: vec![[255, 0, 0]; voxels.len()],
            voxels,
            placement: Placement::VOXEL_GRID,
        };
        (Surface::new(&mesh), cloud)
    }

    #[test]
    fn a_mesh_and_its_cloud_are_seen_at_the_same_place_in_the_same_colours() {
        let (surface, cloud) = ball();
        let camera = Camera::orbit(30.0, 20.0, 2.6, 45.0, 96, 80).unwrap();
        let mesh = of_mesh(&surface, &camera);
        let drawn = Renderer::new().render(&of_cloud(&cloud).unwrap(), &camera).unwrap();
        assert_eq!((mesh.width, mesh.height), (96, 80));
        let red = mesh.pixels.iter().filter(|p| p[1] < 0.5).count();
        assert!(red > 300 && red < 96 * 80 / 2, "{red}");
        assert!(
            pixels_apart(&mesh, &drawn).0 < 0.01,
            "{}",
            pixels_apart(&mesh, &drawn).0
        );
    }
}
