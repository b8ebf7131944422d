//! Every module against its definition.

use b2p_kernels::Isa;

use super::super::reference::{Mode, Oracle, Rows};
use super::super::{Head, Model, RAW, Shape, Upsample, untrained};
use super::{Cloud, coarser, error, rows};
use crate::gaussians::Heads;
use crate::layers::Precision;

/// Networks that together have every switch in both positions.
pub(super) fn shapes() -> Vec<Shape> {
    let mut nearest = Shape {
        upsample: Upsample::Nearest,
        inception_relu: false,
        resblock_relu: false,
        ..Shape::tiny()
    };
    nearest.base_channels = 0;
    nearest.near_channels = [0, 8];
    nearest.gg[0].channels = 12;
    nearest.gg[1].blocks_before = 0;
    let wide = Shape {
        channels: 20,
        latents: 5,
        fc_blocks: 2,
        pem_blocks: 2,
        fr_blocks: 2,
        ..Shape::tiny()
    };
    let mut both = Shape {
        channels: 32,
        ..Shape::tiny()
    }
    .with_quick_heads();
    both.gg[2].channels = 16;
    both.gg[3].blocks_before = 1;
    let with_latents = |latent_roles, fr_roles, near_channels| Shape {
        latent_roles,
        fr_roles,
        near_channels,
        ..Shape::tiny()
    };
    vec![
        Shape::tiny(),
        nearest,
        wide,
        both,
        with_latents(2, 3, [8, 0]),
        with_latents(1, 3, [0, 0]),
        with_latents(2, 2, [8, 0]),
        with_latents(1, 1, [0, 0]),
    ]
}

/// Latents of a plausible spread.
pub(super) fn latents(count: usize) -> Vec<i16> {
    (0..count)
        .map(|i| ((i * i * 7 + i * 13) % 11) as i16 - 5 + if i % 97 == 0 { 26 } else { 0 })
        .collect()
}

/// What a decoder computes for one role.
#[derive(Default)]
struct Level<A, B = A> {
    context: A,
    mu: A,
    sigma: B,
    g: A,
}

/// All roles, from made-up latents.
fn decode(model: &Model, cloud: &Cloud) -> Vec<Level<Vec<i16>, Vec<u8>>> {
    let mut levels: Vec<Level<Vec<i16>, Vec<u8>>> = Vec::new();
    for role in 0..3 {
        let (map, y) = (
            &cloud.maps[role],
            latents(cloud.len(role) * model.shape().latents_of(role)),
        );
        levels.push(match levels.last() {
            None => Level {
                g: model.reconstruct(role, &y, None, map),
                ..Level::default()
            },
            Some(below) => {
                let context = model.upsample(role, &below.g, cloud.occupancy(role - 1));
                let (mu, sigma) = match model.has_latents(role) {
                    true => model.entropy_parameters(role, &context, map),
                    false => Default::default(),
                };
                let g = model.reconstruct(role, &y, Some(&context), map);
                Level { context, mu, sigma, g }
            }
        });
    }
    levels
}

/// The same by definition.
fn decode_by_definition(oracle: &Oracle, cloud: &Cloud) -> Vec<Level<Rows>> {
    let mut levels: Vec<Level<Rows>> = Vec::new();
    for role in 0..3 {
        let (sites, k) = (cloud.sites(role), oracle.shape.latents_of(role));
        let y = match k {
            0 => vec![Vec::new(); cloud.len(role)],
            _ => rows(&latents(cloud.len(role) * k), k),
        };
        levels.push(match levels.last() {
            None => Level {
                g: oracle.reconstruct(role, &sites, &y, None),
                ..Level::default()
            },
            Some(below) => {
                let context = oracle.upsample(role, &cloud.sites(role - 1), &sites, &below.g);
                let (mu, sigma) = match k {
                    0 => Default::default(),
                    _ => oracle.entropy(role, &sites, &context),
                };
                let g = oracle.reconstruct(role, &sites, &y, Some(&context));
                Level { context, mu, sigma, g }
            }
        });
    }
    levels
}

#[test]
fn the_exact_zone_equals_its_definition_to_the_bit_on_every_isa_and_thread_count() {
    println!("ran on {:?}", Isa::available());
    let cloud = Cloud::sheet();
    for (seed, shape) in (0..).zip(shapes()) {
        let bytes = untrained(&shape, seed);
        let want = decode_by_definition(&Oracle::new(&bytes, Mode::Whole), &cloud);
        let (c, k) = (shape.channels, shape.latents);
        for isa in Isa::available() {
            for threads in [1, 3] {
                let model = Model::from_bytes(&bytes).unwrap().with_isa(isa);
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                let got = pool.install(|| decode(&model, &cloud));
                for (role, (got, want)) in got.iter().zip(&want).enumerate() {
                    let at = format!("{isa}, {threads} threads, {c} channels, role {role}");
                    assert!(rows(&got.context, c) == want.context, "context: {at}");
                    assert!(rows(&got.mu, k) == want.mu, "means: {at}");
                    assert!(rows(&got.sigma, k) == want.sigma, "scales: {at}");
                    assert!(rows(&got.g, c) == want.g, "features: {at}");
                }
            }
        }
    }
}

#[test]
fn made_up_models_use_their_range_and_stay_inside() {
    let cloud = Cloud::sheet();
    let model = Model::from_bytes(&untrained(&Shape::tiny(), 5)).unwrap();
    for (role, Level { mu, sigma, g, .. }) in decode(&model, &cloud).into_iter().enumerate() {
        let deviation = |q: &[i16]| (q.iter().map(|&q| f64::from(q).powi(2)).sum::<f64>() / q.len() as f64).sqrt();
        assert!(
            (30.0..1200.0).contains(&deviation(&g)),
            "role {role}: {}",
            deviation(&g)
        );
        let clipped = g.iter().filter(|q| q.abs() == 2047).count();
        assert!(clipped * 20 < g.len(), "role {role}: {clipped} of {} saturate", g.len());
        if role > 0 {
            assert!(
                (2.0..400.0).contains(&deviation(&mu)),
                "role {role}: {}",
                deviation(&mu)
            );
            let mut kinds = sigma.clone();
            kinds.sort_unstable();
            kinds.dedup();
            assert!(kinds.len() > 5, "role {role}: scales {kinds:?}");
        }
    }
}

#[test]
fn the_exact_zone_follows_the_real_function_it_rounds() {
    let cloud = Cloud::sheet();
    let bytes = untrained(&Shape::tiny(), 5);
    let (whole, real) = (Oracle::new(&bytes, Mode::Whole), Oracle::new(&bytes, Mode::Real));
    for role in 0..3 {
        // Inputs small enough that nothing on the way is cut off: there the real function goes its own way.
        let sites = cloud.sites(role);
        let y: Vec<i16> = latents(cloud.len(role) * 4).into_iter().map(|y| y % 3).collect();
        let c: Vec<i16> = (0..cloud.len(role) * 8)
            .map(|i| ((i * 7919) % 401) as i16 - 200)
            .collect();
        let (y, c) = (rows(&y, 4), rows(&c, 8));
        let near = |what: &str, whole: Rows, real: Rows, steps: f64| {
            let differences = whole
                .iter()
                .flatten()
                .zip(real.iter().flatten())
                .map(|(a, b)| (a - b).powi(2));
            let off = (differences.sum::<f64>() / (whole.len() * whole[0].len()) as f64).sqrt();
            println!("role {role}, {what}: {off:.2} steps");
            assert!(off < steps, "role {role}, {what}: {off} steps off");
        };
        let context = (role > 0).then_some(&c);
        let features = |oracle: &Oracle| oracle.reconstruct(role, &sites, &y, context);
        near("features", features(&whole), features(&real), 2.0);
        if role > 0 {
            let ((mu, sigma), (real_mu, real_sigma)) =
                (whole.entropy(role, &sites, &c), real.entropy(role, &sites, &c));
            near("means", mu, real_mu, 1.0);
            near("scales", sigma, real_sigma, 1.0);
        }
    }
}

/// f16 keeps 11 bits: half a unit of the last is 2⁻¹² of a value. About ten layers are stored on the way to any result
/// here, and a layer's sum weighs the errors of its inputs as it does the inputs.
const TOLERANCE: f64 = 10.0 / 4096.0;

#[test]
fn generation_follows_its_definition_within_f16() {
    let cloud = Cloud::sheet();
    for (seed, shape) in (10..).zip(shapes()) {
        let bytes = untrained(&shape, seed);
        let oracle = Oracle::new(&bytes, Mode::Whole);
        let model = in_floats(&bytes);
        for &Head { role, heads, .. } in &shape.gg {
            let g = some_features(cloud.len(role) * shape.channels);
            let features = rows(&g, shape.channels);
            let want = oracle.generate(heads, role, &cloud.sites(role), &features);
            let generate = |model: &Model| model.generate_with(heads, role, &g, &cloud.maps[role]);
            let got = generate(&model).unwrap();
            assert_eq!(got.len(), want.len() * RAW);
            let (off, peak) = error(&got, &want);
            println!("{heads}, role {role}: {:.2e} of {peak:.2}", off / peak);
            assert!(off < TOLERANCE * peak, "role {role}: off by {off} of {peak}");
            for isa in Isa::available() {
                let other = in_floats(&bytes).with_isa(isa);
                assert!(generate(&other).unwrap() == got, "{isa} rounds in another order");
            }
        }
    }
}

fn in_floats(model: &[u8]) -> Model {
    let model = Model::from_bytes(model).unwrap();
    model.with_precision(Precision::F16).unwrap()
}

/// Features that use the middle of their range.
pub(super) fn some_features(count: usize) -> Vec<i16> {
    (0..count).map(|i| ((i * 7919) % 1601) as i16 - 800).collect()
}

/// Raw numbers in integers lie so near their definition, in parts of the largest: each of a dozen layers rounds to a
/// step of 1/256 where the largest is about 4.
const INTEGER_TOLERANCE: f64 = 0.01;

#[test]
fn generation_in_integers_follows_its_definition_and_is_the_same_on_every_isa_and_thread_count() {
    let cloud = Cloud::sheet();
    for (seed, shape) in (10..).zip(shapes()) {
        let bytes = untrained(&shape, seed);
        let oracle = Oracle::new(&bytes, Mode::Whole);
        assert_eq!(Model::from_bytes(&bytes).unwrap().precision(), Precision::Int16);
        for &Head { role, heads, .. } in &shape.gg {
            let g = some_features(cloud.len(role) * shape.channels);
            let features = rows(&g, shape.channels);
            let want = oracle.generate(heads, role, &cloud.sites(role), &features);
            let mut first: Option<Vec<f32>> = None;
            for isa in Isa::available() {
                for threads in [1, 3] {
                    let model = Model::from_bytes(&bytes).unwrap().with_isa(isa);
                    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
                    let map = &cloud.maps[role];
                    let generate = || model.generate_with(heads, role, &g, map).unwrap();
                    let got = pool.build().unwrap().install(generate);
                    let (off, peak) = error(&got, &want);
                    println!("{isa}, {heads}, role {role}: {:.2e} of {peak:.2}", off / peak);
                    assert!(off < INTEGER_TOLERANCE * peak, "off by {off} of {peak}");
                    let first = first.get_or_insert_with(|| got.clone());
                    assert!(*first == got, "{isa}, {threads} threads: other bits");
                }
            }
        }
    }
}

/// The ends of the range of activations in steps of 1/256, as those of untrained networks are.
const RANGE: f64 = 2047.0 / 256.0;

#[test]
fn generation_in_integers_saturates_where_activations_leave_their_range() {
    let cloud = Cloud::sheet();
    for (shape, seed) in [(3, 116), (4, 118), (7, 115)] {
        let shape = &shapes()[shape];
        let bytes = untrained(shape, seed);
        let role = 1;
        let g = some_features(cloud.len(role) * shape.channels);
        let features = rows(&g, shape.channels);
        let by_definition = |oracle: Oracle| oracle.generate(Heads::Best, role, &cloud.sites(role), &features);
        let whole = by_definition(Oracle::new(&bytes, Mode::Whole));
        let bounded = by_definition(Oracle::new(&bytes, Mode::Whole).saturating(RANGE));
        let model = Model::from_bytes(&bytes).unwrap();
        let got = model.generate_with(Heads::Best, role, &g, &cloud.maps[role]);
        let got = got.unwrap();
        let (without, _) = error(&got, &whole);
        let (off, peak) = error(&got, &bounded);
        println!(
            "seed {seed}: {:.2e}, unbounded {:.2e} of {peak:.2}",
            off / peak,
            without / peak
        );
        assert!(without > INTEGER_TOLERANCE * peak, "seed {seed} stays within its range");
        assert!(off < INTEGER_TOLERANCE * peak, "off by {off} of {peak}");
    }
}

#[test]
fn conversion_and_squeezing_follow_their_definition_within_f16_or_bf16() {
    let cloud = Cloud::sheet();
    let colours: Vec<[f32; 3]> = (0..cloud.len(3))
        .map(|i| [i % 7, i % 11, i % 29].map(|c| c as f32 / 29.0))
        .collect();
    let sites: Vec<_> = (0..4).rev().map(|role| cloud.sites(role)).collect();
    for (seed, shape) in (20..).zip(shapes()) {
        let bytes = untrained(&shape, seed);
        let oracle = Oracle::new(&bytes, Mode::Whole);
        let mut want = oracle.features(&sites.iter().collect::<Vec<_>>(), &rows(colours.as_flattened(), 3));
        want.reverse();
        for isa in Isa::available() {
            let model = Model::from_bytes(&bytes).unwrap().with_isa(isa);
            let tolerance = TOLERANCE * coarser(isa);
            let got = cloud.features(&model, &colours);
            for role in 0..3 {
                let (off, peak) = error(&got[role], &want[role]);
                println!("{isa}, features {role}: {:.2e} of {peak:.2}", off / peak);
                assert!(off < tolerance * peak, "{isa}, role {role}: off by {off} of {peak}");
                let c: Option<Vec<i16>> =
                    (role > 0).then(|| (0..got[role].len()).map(|i| ((i * 7919) % 1601) as i16 - 800).collect());
                let y = model.squeeze(role, &got[role], c.as_deref()).unwrap();
                if !model.has_latents(role) {
                    assert!(y.is_empty(), "{isa}, role {role} has no latents");
                    continue;
                }
                let c = c.map(|c| rows(&c, shape.channels));
                let y_want = oracle.squeeze(role, &cloud.sites(role), &rows(&got[role], shape.channels), c.as_ref());
                let (off, peak) = error(&y, &y_want);
                println!("{isa}, latents {role}: {:.2e} of {peak:.2}", off / peak);
                assert!(off < tolerance * peak, "{isa}, role {role}: off by {off} of {peak}");
            }
        }
    }
}

#[test]
fn fewer_levels_start_from_the_same_first_conversion() {
    let cloud = Cloud::sheet();
    let bytes = untrained(&Shape::tiny(), 30);
    let (model, oracle) = (Model::from_bytes(&bytes).unwrap(), Oracle::new(&bytes, Mode::Whole));
    let colours = vec![[0.25, 0.5, 0.75]; cloud.len(3)];
    let got = model
        .features(&colours, &[&cloud.maps[3], &cloud.maps[2]], &[cloud.occupancy(2)])
        .unwrap();
    let want = oracle.features(&[&cloud.sites(3), &cloud.sites(2)], &rows(colours.as_flattened(), 3));
    assert_eq!((got.len(), want.len()), (1, 1));
    let (off, peak) = error(&got[0], &want[0]);
    assert!(off < TOLERANCE * coarser(model.isa()) * peak, "off by {off} of {peak}");
}
