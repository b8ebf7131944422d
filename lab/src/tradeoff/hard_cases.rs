//! Which fast setting breaks which case.

use b2p::Isa;
use serde::Serialize;

use super::MeasuredInput;
use super::double;
use super::scenes::{Random, Scene, hard_scenes};
use super::setting::QUALITIES;
use b2p::Result;
use b2p::gaussians::learned::{HeadsModel, LevelInput};
use b2p::gaussians::{Frame, Gaussians, Heads};
use b2p::geometry::{Octree, Voxels, morton};
use b2p::latents::activate;
use b2p::latents::network::Model;
use b2p::layers::Precision;
use b2p::metrics::{pixels_apart, psnr};
use b2p::renderer::camera::Camera;
use b2p::renderer::reference::{self, Cutoffs};
use b2p::renderer::{Background, Image, Quality, Renderer};

/// The largest error, in steps of eight bits, that is held to be none.
pub const BOUND: f64 = 2.0;

/// A case, and what each setting makes of it.
#[derive(Debug, Clone, Serialize)]
pub struct HardCase {
    /// What is hard.
    pub name: String,
    /// Each setting's error against double precision.
    pub errors: Vec<CaseError>,
}

/// How far a setting is off.
#[derive(Debug, Clone, Serialize)]
pub struct CaseError {
    /// A quality, an instruction set, or a precision.
    pub setting: String,
    /// The largest difference of a channel in steps of eight bits.
    pub worst: f64,
    /// PSNR in dB; `None` of equal pictures.
    pub psnr: Option<f64>,
}

impl CaseError {
    fn between(setting: String, truth: &Image, picture: &Image) -> CaseError {
        let (mean_square, worst, _) = pixels_apart(truth, picture);
        CaseError {
            setting,
            worst,
            psnr: Some(psnr(mean_square)).filter(|psnr| psnr.is_finite()),
        }
    }
}

/// Every hard scene with every quality, and with the default one on every other instruction set.
///
/// # Errors
/// Those of [`Renderer::render`](b2p::renderer::Renderer::render).
pub fn renderer_cases(subject: &MeasuredInput<'_>) -> Result<Vec<HardCase>> {
    let best = Isa::detect();
    let mut settings: Vec<(String, Quality, Isa)> = QUALITIES
        .iter()
        .map(|&quality| (quality.to_string(), quality, best))
        .collect();
    let others = Isa::available().into_iter().filter(|isa| *isa != best);
    settings.extend(others.map(|isa| {
        let quality = Quality::default();
        (format!("{quality}, {isa}"), quality, isa)
    }));
    let of_scene = |scene: Scene| {
        let Scene {
            name,
            gaussians,
            camera,
        } = scene;
        let truth = reference::render(&gaussians, &camera, Background::WHITE, Cutoffs::NONE);
        let error = |(setting, quality, isa): &(String, Quality, Isa)| {
            let renderer = Renderer::new().with_isa(*isa).with_quality(*quality);
            let limits = subject.limits.clone();
            let drawn = renderer.with_limits(limits).render(&gaussians, &camera)?;
            Ok(CaseError::between(setting.clone(), &truth, &drawn))
        };
        Ok(HardCase {
            name: name.into(),
            errors: settings.iter().map(error).collect::<Result<_>>()?,
        })
    };
    hard_scenes()?.into_iter().map(of_scene).collect()
}

/// Octree level of the voxels that generators are tried on.
const LEVEL: u8 = 5;

/// The model's networks on inputs that are hard to compute with, in every precision.
///
/// # Errors
/// Those of reading the model, and of generating Gaussians.
pub fn network_cases(subject: &MeasuredInput<'_>) -> Result<Vec<HardCase>> {
    match subject.is_learned() {
        true => latent_cases(subject),
        false => heads_cases(subject),
    }
}

/// A picture that adds no error of its own.
fn picture(gaussians: &Gaussians) -> Result<Image> {
    let camera = Camera::orbit(20.0, 20.0, 2.6, 45.0, 96, 96)?;
    Ok(reference::render(gaussians, &camera, Background::WHITE, Cutoffs::NONE))
}

/// Colours of the voxels of a level and of the level above, and the quantisation step.
type Coloured = (Vec<[u8; 3]>, Vec<[u8; 3]>, f32);

/// Heads of streams of version 3 on colours that no object has.
fn heads_cases(subject: &MeasuredInput<'_>) -> Result<Vec<HardCase>> {
    let model = HeadsModel::from_bytes(subject.model)?;
    let extremes = |count: usize| -> Vec<[u8; 3]> {
        let mut random = Random(7);
        let mut end = || if random.unit() < 0.5 { 0 } else { 255 };
        (0..count).map(|_| [end(), end(), end()]).collect()
    };
    let grey = |count: usize| vec![[128; 3]; count];
    let ball = ball(LEVEL, 9.0);
    let lone = Voxels::new(LEVEL, vec![morton::encode([16, 16, 16])]);
    type Colours<'a> = &'a dyn Fn(usize, usize) -> Coloured;
    let cases: [(&str, &Voxels, Colours); 5] = [
        ("one grey", &ball, &|n, m| (grey(n), grey(m), 1.0)),
        ("random extremes", &ball, &|n, m| (extremes(n), extremes(m), 16.0)),
        ("white below black", &ball, &|n, m| {
            (vec![[255; 3]; n], vec![[0; 3]; m], 16.0)
        }),
        ("random extremes, the coarsest step", &ball, &|n, m| {
            (extremes(n), extremes(m), 65_536.0)
        }),
        ("a single voxel", &lone, &|n, m| (extremes(n), grey(m), 16.0)),
    ];
    let mut all = Vec::new();
    for set in model.sets() {
        for (name, voxels, colours) in cases {
            let octree = Octree::new(voxels.clone())?;
            let (map, above) = (octree.sibling_map(LEVEL), octree.sibling_map(LEVEL - 1));
            let (colours, colours_above, luma_step) = colours(map.len(), above.len());
            let input = LevelInput {
                octree: &octree,
                level: LEVEL,
                map: &map,
                above: &above,
                colours: &colours,
                colours_above: &colours_above,
                luma_step,
                without: None,
                range: None,
            };
            let truth = picture(&double::generate(subject.model, set, &input, Frame::default())?)?;
            let mut errors = Vec::new();
            for precision in Precision::ALL {
                if precision == Precision::Half && !Isa::detect().has_half() {
                    continue;
                }
                let made = model.generate(Isa::detect(), precision, set, input, Frame::default())?;
                errors.push(CaseError::between(precision.to_string(), &truth, &picture(&made)?));
            }
            let name = format!("{name}, {} heads, {} Gaussians a voxel", set.0, set.1);
            all.push(HardCase { name, errors });
        }
    }
    Ok(all)
}

/// Generators of a model of version 2 on features that no encoder makes.
fn latent_cases(subject: &MeasuredInput<'_>) -> Result<Vec<HardCase>> {
    let model = Model::from_bytes(subject.model)?;
    let mut others = Vec::new();
    for precision in Precision::ALL {
        if let Ok(other) = Model::from_bytes(subject.model)?.with_precision(precision) {
            others.push((precision, other));
        }
    }
    let ball = ball(LEVEL, 9.0);
    let mut cases = Vec::new();
    for head in &model.shape().gg {
        let c = model.shape().channels;
        let mut try_on = |name: &str, voxels: &Voxels, features: &dyn Fn(usize) -> Vec<i16>| {
            let octree = Octree::new(voxels.clone())?;
            let map = octree.kernel_map(LEVEL);
            let g = features(voxels.len());
            let picture = |raw: &[f32]| {
                let gaussians = activate(raw, voxels, head.children, model.shape(), Frame::default());
                picture(&gaussians)
            };
            let truth = picture(&model.generate_in_double(head.heads, head.role, &g, &map)?)?;
            let error = |(precision, model): &(Precision, Model)| {
                let raw = model.generate_with(head.heads, head.role, &g, &map)?;
                Ok(CaseError::between(precision.to_string(), &truth, &picture(&raw)?))
            };
            let errors = others.iter().map(error).collect::<Result<_>>()?;
            let heads = match head.heads {
                Heads::Best => String::new(),
                heads => format!(", {heads} heads"),
            };
            let name = format!("{name}, {} Gaussians a voxel{heads}", head.children);
            cases.push(HardCase { name, errors });
            Result::Ok(())
        };
        let random = |limit: f32| {
            move |voxels: usize| {
                let mut random = Random(7);
                let feature = |_| ((2.0 * random.unit() - 1.0) * limit) as i16;
                (0..voxels * c).map(feature).collect::<Vec<i16>>()
            }
        };
        try_on("features of zero variance", &ball, &|n| vec![0; n * c])?;
        try_on("features at their ends, of random sign", &ball, &|n| {
            let signs = random(1000.0)(n);
            signs.iter().map(|s| if *s < 0 { -2047 } else { 2047 }).collect()
        })?;
        try_on("features all at their upper end", &ball, &|n| vec![2047; n * c])?;
        try_on("features from extreme latents", &ball, &|n| {
            let k = model.shape().latents;
            let latent = |i: usize| [i16::MAX, i16::MIN][i % 2];
            let latents: Vec<i16> = (0..n * k).map(latent).collect();
            // Without a context only the base level's reconstruction can be asked.
            let octree = Octree::new(ball.clone());
            octree.map_or(vec![0; n * c], |octree| {
                model.reconstruct(0, &latents, None, &octree.kernel_map(LEVEL))
            })
        })?;
        let lone = Voxels::new(LEVEL, vec![morton::encode([16, 16, 16])]);
        try_on("a single voxel", &lone, &random(400.0))?;
    }
    Ok(cases)
}

/// The voxels on the surface of a ball in the middle of the cube.
fn ball(depth: u8, radius: f32) -> Voxels {
    let side = 1u32 << depth;
    let middle = side as f32 / 2.0;
    let places = (0..side.pow(3)).map(|i| [i % side, i / side % side, i / side / side]);
    let on_surface = |at: &[u32; 3]| {
        let squares = at.map(|v| (v as f32 + 0.5 - middle).powi(2));
        (squares.iter().sum::<f32>().sqrt() - radius).abs() < 0.6
    };
    Voxels::new(depth, places.filter(on_surface).map(morton::encode).collect())
}
