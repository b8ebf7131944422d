//! The trainer's own results on a small cloud: an untrained tiny model, and every number PyTorch computed with it.

use b2p_kernels::Isa;

use super::super::{Model, RAW};
use super::{Cloud, all_passes, coarser, error, rows};
use crate::gaussians::Frame;
use crate::geometry::morton;
use crate::latents::activate;
use crate::layers::{Element, Tensors};

const MODEL: &[u8] = include_bytes!("../../../../tests/data/tiny.safetensors");
const GOLDEN: &[u8] = include_bytes!("../../../../tests/data/golden.safetensors");

fn golden<T: Element>(name: &str) -> Vec<T> {
    Tensors::new(GOLDEN).unwrap().list(name).unwrap()
}

fn model() -> Model {
    Model::from_bytes(MODEL).unwrap()
}

/// The cloud, the trainer's voxels being in Morton order as ours are.
fn cloud() -> Cloud {
    let coordinates = |role: usize| -> Vec<[u32; 3]> {
        let flat: Vec<i32> = golden(&format!("xyz.{role}"));
        flat.chunks(3)
            .map(|v| [v[0] as u32, v[1] as u32, v[2] as u32])
            .collect()
    };
    let cloud = Cloud::new(5, &coordinates(3));
    for role in 0..4 {
        let keys: Vec<u64> = coordinates(role).into_iter().map(morton::encode).collect();
        assert_eq!(cloud.octree.level(cloud.level(role)).keys(), keys);
    }
    cloud
}

#[test]
fn the_exact_zone_computes_the_trainer_s_integers() {
    let (model, cloud) = (model(), cloud());
    let values = |name: &str, role: usize| -> Vec<i16> { golden(&format!("{name}.{role}")) };
    for role in 0..3 {
        let map = &cloud.maps[role];
        let octants = cloud.octree.level(cloud.level(role)).octants();
        let passes =
            |level: Option<(&[i16], &[u8])>| all_passes(&model, role, &octants, map, &values("latent", role), level);
        let context = (role > 0).then(|| model.upsample(role, &values("g", role - 1), cloud.occupancy(role - 1)));
        if let Some(context) = &context {
            assert_eq!(context, &values("c", role));
            let (mu, sigma) = model.entropy_parameters(role, context, map);
            assert_eq!(mu, values("pem.mu", role));
            assert_eq!(sigma, golden::<u8>(&format!("pem.sigma.{role}")));
            let (mu, sigma) = passes(Some((&mu, &sigma)));
            assert_eq!(mu, values("mu", role));
            assert_eq!(sigma, golden::<u8>(&format!("sigma.{role}")));
        } else {
            let (mu, sigma) = passes(None);
            assert_eq!(mu, values("mu", role));
            assert_eq!(sigma, golden::<u8>("sigma.0"));
        }
        let g = model.reconstruct(role, &values("latent", role), context.as_deref(), map);
        assert_eq!(g, values("g", role), "role {role}");
    }
}

#[test]
fn integer_distributions_are_those_that_the_float_network_predicts() {
    let per_nat = 63.0 / (64.0f64 / 0.11).ln();
    for role in [1, 2] {
        let mu: Vec<i16> = golden(&format!("pem.mu.{role}"));
        let real: Vec<f32> = golden(&format!("float.mu.{role}"));
        // Weights of ten bits and activations of twelve add about as much as rounding to a sixteenth does.
        for (&q, &real) in mu.iter().zip(&real) {
            assert!(
                (f64::from(q) / 16.0 - f64::from(real)).abs() < 1.0 / 16.0,
                "role {role}: {q} for {real}"
            );
        }
        let sigma: Vec<u8> = golden(&format!("pem.sigma.{role}"));
        let real: Vec<f32> = golden(&format!("float.lnsigma.{role}"));
        for (&q, &real) in sigma.iter().zip(&real) {
            let index = (f64::from(real) - 0.11f64.ln()) * per_nat;
            assert!((f64::from(q) - index).abs() < 1.0, "role {role}: {q} for {index}");
        }
    }
}

/// f16 keeps 11 bits: half a unit of the last is 2⁻¹² of a value. About ten layers are stored on the way to any of
/// these results.
const TOLERANCE: f64 = 10.0 / 4096.0;

#[test]
fn the_encoder_s_features_and_latents_are_the_trainer_s_within_f16_or_bf16() {
    let cloud = cloud();
    let colours: Vec<[f32; 3]> = golden::<u8>("rgb")
        .chunks(3)
        .map(|c| [c[0], c[1], c[2]].map(|c| f32::from(c) / 255.0))
        .collect();
    for isa in Isa::available() {
        let (model, tolerance) = (model().with_isa(isa), TOLERANCE * coarser(isa));
        for (role, features) in cloud.features(&model, &colours).iter().enumerate() {
            let want = rows(&golden::<f32>(&format!("fc.{role}")), 16);
            let (off, peak) = error(features, &want);
            println!("{isa}, fc.{role}: {:.2e} of {peak:.2}", off / peak);
            assert!(off < tolerance * peak, "{isa}, fc.{role}: off by {off} of {peak}");
            let context: Option<Vec<i16>> = (role > 0).then(|| golden(&format!("c.{role}")));
            let y = model.squeeze(role, features, context.as_deref()).unwrap();
            let want = rows(&golden::<f32>(&format!("fs.{role}")), 4);
            let (off, peak) = error(&y, &want);
            println!("{isa}, fs.{role}: {:.2e} of {peak:.2}", off / peak);
            assert!(off < tolerance * peak, "{isa}, fs.{role}: off by {off} of {peak}");
            // Only what lies near a half may round the other way.
            let limit = f32::from(model.shape().latent_max);
            let round = |y: &f32| y.clamp(-limit, limit).round_ties_even() as i16;
            for ((q, &want), &y) in y
                .iter()
                .map(round)
                .zip(&golden::<i16>(&format!("latent.{role}")))
                .zip(want.iter().flatten())
            {
                let margin = ((y - y.floor()) - 0.5).abs();
                assert!(q == want || margin < tolerance * peak, "{isa}, fs.{role}: {q} for {y}");
            }
        }
    }
}

#[test]
fn generated_gaussians_are_the_trainer_s_within_f16() {
    let (model, cloud) = (model(), cloud());
    for role in [1, 2] {
        let g: Vec<i16> = golden(&format!("g.{role}"));
        let raw = model.generate(role, &g, &cloud.maps[role]).unwrap();
        let want = rows(&golden::<f32>(&format!("raw.{role}")), RAW);
        let (off, peak) = error(&raw, &want);
        println!("raw.{role}: {:.2e} of {peak:.2}", off / peak);
        assert!(off < TOLERANCE * peak, "raw.{role}: off by {off} of {peak}");

        let voxels = cloud.octree.level(cloud.level(role));
        let children = if role == 1 { 8 } else { 1 };
        // The trainer's own raw numbers, so that only the activations are compared. Its unit is the finest voxel, 1/32
        // of the cube.
        let trained = activate(
            &golden::<f32>(&format!("raw.{role}")),
            voxels,
            children,
            model.shape(),
            Frame::default(),
        );
        let close = |name: &str, got: Vec<f64>, unit: f64| {
            let want: Vec<f32> = golden(&format!("gauss.{role}.{name}"));
            assert_eq!(got.len(), want.len(), "{name}");
            for (got, &want) in got.iter().zip(&want) {
                assert!(
                    (got - f64::from(want)).abs() < 1e-5 * unit,
                    "{name}: {got} is not {want}"
                );
            }
        };
        close(
            "mean",
            trained
                .position
                .iter()
                .flatten()
                .map(|&p| (f64::from(p) + 1.0) * 16.0)
                .collect(),
            32.0,
        );
        close("opacity", trained.opacity.iter().map(|&o| o.into()).collect(), 1.0);
        close(
            "colour",
            trained.colour.iter().flatten().map(|&c| c.into()).collect(),
            1.0,
        );
        let covariances = trained
            .scale
            .iter()
            .zip(&trained.rotation)
            .flat_map(|(s, q)| covariance(*s, *q));
        close("cov", covariances.map(|c| c * 256.0).collect(), 4.0);
    }
}

/// R S² Rᵀ: xx, xy, xz, yy, yz, zz.
fn covariance(scale: [f32; 3], [w, x, y, z]: [f32; 4]) -> [f64; 6] {
    let [w, x, y, z] = [w, x, y, z].map(f64::from);
    let r = [
        [
            1.0 - 2.0 * (y * y + z * z),
            2.0 * (x * y - w * z),
            2.0 * (x * z + w * y),
        ],
        [
            2.0 * (x * y + w * z),
            1.0 - 2.0 * (x * x + z * z),
            2.0 * (y * z - w * x),
        ],
        [
            2.0 * (x * z - w * y),
            2.0 * (y * z + w * x),
            1.0 - 2.0 * (x * x + y * y),
        ],
    ];
    let entry = |i: usize, j: usize| (0..3).map(|k| r[i][k] * r[j][k] * f64::from(scale[k]).powi(2)).sum();
    [
        entry(0, 0),
        entry(0, 1),
        entry(0, 2),
        entry(1, 1),
        entry(1, 2),
        entry(2, 2),
    ]
}
