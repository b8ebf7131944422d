//! Kernels and pictures.

use std::sync::LazyLock;

use b2p::gaussians::Gaussians;
use b2p::geometry::{Octree, Voxels};
use b2p::latents::network::{Model, Shape, untrained};
use b2p::layers::Precision;
use b2p::renderer::camera::Camera;
use b2p::renderer::{Image, Renderer};
use b2p::{Isa, Limits};

use crate::{Source, one_in};

/// Models of several widths, each with the instructions of every set, the plainest first.
fn models(precision: Precision) -> Vec<Vec<Model>> {
    let sets = |channels| {
        let shape = Shape {
            channels,
            // Only the widest has latents at its finest level, and the second does not even make features of it.
            latent_roles: if channels == 32 { 3 } else { 2 },
            fr_roles: if channels == 12 { 2 } else { 3 },
            near_channels: [8, 0],
            ..Shape::tiny()
        };
        let bytes = untrained(&shape, 5);
        let load = |isa| {
            let model = Model::from_bytes(&bytes).expect("a model").with_isa(isa);
            model.with_precision(precision).expect("it has both")
        };
        let mut sets = vec![load(Isa::SCALAR)];
        sets.extend(Isa::available().into_iter().skip(1).map(load));
        sets
    };
    [8, 12, 32].map(sets).into()
}

static MODELS: LazyLock<Vec<Vec<Model>>> = LazyLock::new(|| models(Precision::Int16));
static FLOATS: LazyLock<Vec<Vec<Model>>> = LazyLock::new(|| models(Precision::F16));

/// Any latents and contexts on any voxels: every instruction set computes what plain code does, to the bit in integers,
/// within a 256th of the largest number in floats. Most inputs ask one module of one instruction set, the others all of
/// all.
pub fn backends(bytes: &[u8]) {
    let mut source = Source(bytes);
    // The widest takes as long as a dozen of the others.
    let which = [0, 0, 0, 0, 1, 1, 1, 2][usize::from(source.byte()) % 8];
    let how = usize::from(source.byte());
    let (role, module, set) = (1 + how % 2, how / 2 % 4, how / 8);
    let all = how >= 240;
    let count = 1 + source.count(5, 39);
    let keys = (0..count).map(|_| u64::from(source.u16()) % 512).collect();
    let octree = Octree::new(Voxels::new(3, keys)).expect("voxels");
    let map = octree.kernel_map(3);
    let shape = MODELS[which][0].shape();
    let latents: Vec<i16> = (0..map.len() * shape.latents_of(role))
        .map(|_| source.u16() as i16)
        .collect();
    let context: Vec<i16> = (0..map.len() * shape.channels)
        .map(|_| (source.u16() as i16).clamp(-2047, 2047))
        .collect();
    let asked = |of: usize| all || module == of;
    let others = |models: &'static [Model]| {
        let others = &models[1..];
        let one = set % others.len().max(1);
        let some = if all { None } else { others.get(one..=one) };
        some.unwrap_or(others)
    };
    let generate = |model: &Model, features: &[i16]| {
        let raw = model.generate(role, features, &map);
        raw.expect("a head")
    };
    let exact = |model: &Model| {
        let features = asked(0).then(|| model.reconstruct(role, &latents, Some(&context), &map));
        let predicted = asked(1) && model.has_latents(role);
        let parameters = predicted.then(|| model.entropy_parameters(role, &context, &map));
        let raw = asked(2).then(|| generate(model, features.as_ref().unwrap_or(&context)));
        let bits = raw.map(|raw| raw.iter().map(|x| x.to_bits()).collect::<Vec<_>>());
        (features, parameters, bits)
    };
    let expected = exact(&MODELS[which][0]);
    for model in others(&MODELS[which]) {
        let isa = model.isa();
        assert!(exact(model) == expected, "{isa} computes otherwise");
    }
    if !asked(3) {
        return;
    }
    let fastest = &MODELS[which][MODELS[which].len() - 1];
    let features = fastest.reconstruct(role, &latents, Some(&context), &map);
    let expected = generate(&FLOATS[which][0], &features);
    let largest = expected.iter().fold(1f32, |m, x| m.max(x.abs()));
    for model in others(&FLOATS[which]) {
        for (a, b) in generate(model, &features).iter().zip(&expected) {
            let isa = model.isa();
            assert!((a - b).abs() <= largest / 256.0, "{isa}: {a}, not {b}");
        }
    }
}

/// Any numbers as Gaussians, before a camera anywhere: an error, or a picture whose every pixel is finite, with work in
/// proportion to Gaussians and pixels, and, for one input in four, the same again.
pub fn render(bytes: &[u8]) {
    let mut source = Source(bytes);
    let [width, height] = [(); 2].map(|()| 1 + source.count(15, 69) as u32);
    let angles = [source.u16(), source.u16()].map(|a| f64::from(a) / 100.0);
    let distance = f64::from(source.byte()) / 32.0;
    let mut g = Gaussians::default();
    while !source.is_empty() && g.len() < 500 {
        let near = source.byte();
        let mut number = || match near % 4 {
            // Anything at all, or something that will be seen.
            0 => source.float(),
            _ => f32::from(source.byte() as i8) / 64.0,
        };
        g.position.push([number(), number(), number()]);
        g.scale.push([number(), number(), number()]);
        g.rotation.push([number(), number(), number(), number()]);
        g.opacity.push(number());
        g.colour.push([number(), number(), number()]);
    }
    let limits = Limits::default().with_max_bytes(64 << 20);
    let fov = 10.0 + angles[0] / 8.0;
    let Ok(camera) = Camera::orbit(angles[0], angles[1], distance, fov, width, height) else {
        return;
    };
    let mut renderer = Renderer::new().with_limits(limits.clone());
    let draw = |renderer: &mut Renderer| {
        let mut image = Image::default();
        let stats = renderer.render_into(&g, &camera, &mut image)?;
        Ok::<_, b2p::Error>((image, stats))
    };
    let Ok((image, stats)) = draw(&mut renderer) else {
        return;
    };
    assert_eq!(image.pixels.len(), (width * height) as usize);
    assert!(image.pixels.as_flattened().iter().all(|v| v.is_finite()));
    let tiles = u64::from(width.div_ceil(32)) * u64::from(height.div_ceil(32));
    assert!(stats.pairs <= g.len() as u64 * tiles);
    assert_eq!(stats.visible + stats.dropped.total(), g.len() as u64);
    if one_in(4, bytes) {
        let (again, _) = draw(&mut renderer).expect("what was drawn once is drawn again");
        assert_eq!(again.pixels, image.pixels);
    }
}
