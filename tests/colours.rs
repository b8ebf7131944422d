//! What streams say of the colours that their models generate: filters and residuals.

mod common;

use b2p::Limits;
use b2p::cloud::ColouredVoxels;
use b2p::container::Stream;
use b2p::encoder::{Encoded, Options, Residual, encode};
use b2p::gaussians::Gaussians;
use b2p::gaussians::Heads;
use b2p::latents::LatentDecoder;
use b2p::latents::network::{Model, Shape, untrained};
use b2p::latents::{ColourFilter, ColourResidual};
use b2p::log::Log;
use b2p::renderer::camera::Camera;
use b2p::renderer::{Background, render};
use common::{Ball, all_in, steps, tiny_model, with_filter, with_residual};

fn model() -> Model {
    Model::from_bytes(&tiny_model(0)).expect("an untrained model loads")
}

fn ball(bits: u8, radius: f32) -> ColouredVoxels {
    Ball::new(bits, radius).cloud()
}

/// A model with both sets of heads, and a stream of it that says nothing of its colours.
fn plain_with_both_heads() -> (Model, Encoded) {
    let shape = Shape::tiny().with_quick_heads();
    let model = Model::from_bytes(&untrained(&shape, 0)).unwrap();
    let options = Options {
        filter: false,
        ..Options::default()
    };
    let plain = encode(&ball(6, 20.0), &model, &options, &Log::default()).unwrap();
    (model, plain)
}

#[test]
fn filters_bring_the_colours_of_gaussians_nearer_to_the_cloud_s_and_change_nothing_else() {
    let (model, cloud) = (model(), ball(8, 90.0));
    let with = |filter| encoded_with(&model, &cloud, filter, Residual::None);
    let (plain, filtered) = (with(false), with(true));
    let decoder = LatentDecoder::new(&model);
    for rate in &filtered.rates[1..] {
        let level = rate.level;
        let bytes = [&plain.bytes, &filtered.bytes];
        let exact = bytes.map(|bytes| decoder.exact(bytes, level, &Log::default()).unwrap());
        assert_eq!(exact[0], exact[1]);
        let decode = |bytes: &Vec<u8>| decoder.decode(bytes, Some(level), &Log::default());
        let [before, after] = bytes.map(|bytes| decode(bytes).unwrap());
        assert_ne!(before.colour, after.colour, "level {level}");
        let recoloured = Gaussians {
            colour: after.colour.clone(),
            ..before.clone()
        };
        assert_eq!(after, recoloured);
        if before.len() == exact[0].octree.level(level).len() {
            let mut right = before.clone();
            right.colour = colours_at(&cloud, level);
            let [before, after, right] = [before, after, right].map(|g| picture(&g));
            let off = |picture: &[[f32; 4]]| {
                let pairs = picture.iter().flatten().zip(right.iter().flatten());
                pairs.map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>()
            };
            let off = [off(&before), off(&after)];
            assert!(off[1] < 0.95 * off[0], "level {level}: {off:?}");
        }
    }
}

#[test]
fn a_filter_for_one_set_of_heads_leaves_the_other_s_colours_as_they_are() {
    let (model, plain) = plain_with_both_heads();
    let mut filter = ColourFilter {
        exponent: 0,
        weights: [[0; _]; 3],
    };
    // An eighth less red.
    filter.weights[0][0] = -128;
    for filtered in Heads::ALL {
        let bytes = with_filter(&plain.bytes, filtered, &filter.to_bytes());
        for heads in Heads::ALL {
            let decoder = LatentDecoder::new(&model).with_heads(heads).unwrap();
            let decode = |bytes| decoder.decode(bytes, None, &Log::default()).unwrap();
            let mut want = decode(&plain.bytes);
            if heads == filtered {
                let reds = want.colour.iter_mut().map(|colour| &mut colour[0]);
                reds.for_each(|red| *red = (*red - 0.125).clamp(0.0, 1.0));
            }
            assert!(decode(&bytes) == want, "{heads}, filter for {filtered}");
        }
    }
}

#[test]
fn a_residual_brings_the_finest_colours_as_near_as_its_step_says_and_changes_nothing_else() {
    let (model, cloud) = (model(), ball(7, 45.0));
    let decoder = LatentDecoder::new(&model);
    let mut last = f64::INFINITY;
    let encoded = |filter, residual| encoded_with(&model, &cloud, filter, residual);
    for filter in [true, false] {
        let plain = encoded(filter, Residual::None);
        let finest = plain.rates.last().unwrap().level;
        for step in [80, 20, 5, 1] {
            let refined = encoded(filter, Residual::Fine(steps(step)));
            for rate in &plain.rates[1..] {
                let level = rate.level;
                let bytes = [&plain.bytes, &refined.bytes];
                let exact = bytes.map(|bytes| decoder.exact(bytes, level, &Log::default()).unwrap());
                assert_eq!(exact[0], exact[1]);
                let decode = |bytes: &Vec<u8>| decoder.decode(bytes, Some(level), &Log::default()).unwrap();
                let [before, after] = bytes.map(decode);
                let recoloured = Gaussians {
                    colour: after.colour.clone(),
                    ..before.clone()
                };
                assert_eq!(after, recoloured);
                if level < finest {
                    assert_eq!(after, before, "level {level}");
                    continue;
                }
                let want = colours_at(&cloud, level);
                let pairs = after.colour.as_flattened().iter().zip(want.as_flattened());
                let squares = pairs.map(|(a, b)| f64::from(a - b).powi(2));
                let off = (squares.sum::<f64>() / (3 * want.len()) as f64).sqrt();
                assert!(off < 0.67 * f64::from(step) / 255.0, "step {step}: {off}");
                assert!(off < last, "step {step}: {off} after {last}");
                last = off;
            }
        }
        last = f64::INFINITY;
    }
}

#[test]
fn every_level_that_is_drawn_may_have_a_residual_of_its_own() {
    let (model, cloud) = (model(), ball(7, 45.0));
    let encoded = |every_level| {
        let options = Options {
            residual: Residual::Fine(steps(5)),
            every_level,
            ..Options::default()
        };
        encode(&cloud, &model, &options, &Log::default()).unwrap()
    };
    let decode = |encoded: &Encoded, level| {
        let decoder = LatentDecoder::new(&model);
        let decoded = decoder.decode(&encoded.bytes, Some(level), &Log::default());
        decoded.unwrap()
    };
    let (finest, all) = (encoded(false), encoded(true));
    let levels = LatentDecoder::new(&model).levels(&all.bytes).unwrap();
    let (&last, coarser) = levels.split_last().unwrap();
    assert_eq!(decode(&finest, last), decode(&all, last));
    assert!(!coarser.is_empty());
    for &level in coarser {
        let colours = colours_at(&cloud, level);
        let children = decode(&all, level).len() / colours.len();
        let want: Vec<[f32; 3]> = (colours.into_iter())
            .flat_map(|colour| vec![colour; children])
            .collect();
        let off = |encoded| {
            let gaussians = decode(encoded, level);
            let pairs = gaussians.colour.as_flattened().iter().zip(want.as_flattened());
            pairs.map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>()
        };
        let (before, after) = (off(&finest), off(&all));
        assert!(after < 0.8 * before, "level {level}: {after} of {before}");
    }
}

#[test]
fn quick_heads_are_corrected_by_the_same_residual() {
    let (model, plain) = plain_with_both_heads();
    let level = plain.rates.last().unwrap().level;
    let octree = LatentDecoder::new(&model).exact(&plain.bytes, level, &Log::default());
    let keys = octree.unwrap().octree.level(level).keys().to_vec();
    // A tenth less of everything.
    let missing = vec![[-0.1; 3]; keys.len()];
    let slice = Options::default().slice_voxels as usize;
    let residual = ColourResidual::of(&missing, &keys, slice, all_in(1)).to_payloads(&keys);
    let bytes = with_residual(&plain.bytes, &residual);
    for heads in Heads::ALL {
        let decoder = LatentDecoder::new(&model).with_heads(heads).unwrap();
        let decode = |bytes| decoder.decode(bytes, None, &Log::default()).unwrap();
        let (before, after) = (decode(&plain.bytes), decode(&bytes));
        let pairs = before.colour.as_flattened().iter().zip(after.colour.as_flattened());
        for (before, after) in pairs {
            let want = (before - 0.1).max(0.0);
            assert!((after - want).abs() < 0.001, "{heads}: {before} to {after}");
        }
    }
}

#[test]
fn the_low_frequency_band_of_the_colour_residual_is_coded_by_default() {
    let (model, cloud) = (model(), ball(8, 90.0));
    let encoded = |filter, residual| encoded_with(&model, &cloud, filter, residual);
    let has = |encoded: &Encoded| {
        let stream = Stream::parse(&encoded.bytes, &Limits::default()).unwrap();
        stream.levels().iter().any(|level| !level.residual.is_empty())
    };
    assert_eq!(Options::default().residual, Residual::Coarse);
    let (none, coarse) = (encoded(true, Residual::None), encoded(true, Residual::Coarse));
    assert!(has(&coarse) && !has(&none));
    assert!(!has(&encoded(false, Residual::Coarse)));
    let decoder = LatentDecoder::new(&model);
    let finest = none.rates.last().unwrap().level;
    let keys = cloud.voxels.keys();
    let mut voxels: Vec<u64> = keys.iter().map(|key| key >> 3).collect();
    voxels.dedup();
    let want = colours_at(&cloud, finest);
    let off = |encoded: &Encoded| {
        let decoded = decoder.decode(&encoded.bytes, None, &Log::default());
        let colours = decoded.unwrap().colour;
        assert_eq!(colours.len(), voxels.len(), "one Gaussian for each voxel");
        let missing = colours.iter().zip(&want);
        let missing = missing.map(|(a, b)| [0, 1, 2].map(|k| f64::from(a[k] - b[k])));
        // The mean of each cell of eight voxels' edge.
        let missing: Vec<_> = voxels.iter().zip(missing).collect();
        let cells = missing.chunk_by(|a, b| a.0 >> 9 == b.0 >> 9);
        let squares = cells.map(|cell| {
            let sum = |k: usize| cell.iter().map(|(_, c)| c[k]).sum::<f64>();
            (0..3).map(|k| sum(k).powi(2)).sum::<f64>() / cell.len() as f64
        });
        squares.sum::<f64>()
    };
    let off = [off(&none), off(&coarse)];
    assert!(off[1] < 0.5 * off[0], "{off:?}");
}

/// A cloud, coded with these corrections of its colours.
fn encoded_with(model: &Model, cloud: &ColouredVoxels, filter: bool, residual: Residual) -> Encoded {
    let options = Options {
        filter,
        residual,
        ..Options::default()
    };
    encode(cloud, model, &options, &Log::default()).unwrap()
}

/// The mean colours of a level's voxels.
fn colours_at(cloud: &ColouredVoxels, level: u8) -> Vec<[f32; 3]> {
    let shift = 3 * (cloud.voxels.depth() - level);
    let voxels: Vec<_> = cloud.voxels.keys().iter().zip(&cloud.colours).collect();
    let mean = |voxels: &[(&u64, &[u8; 3])]| {
        let sum = |c: usize| voxels.iter().map(|(_, x)| f32::from(x[c])).sum::<f32>();
        std::array::from_fn(|c| sum(c) / (255 * voxels.len()) as f32)
    };
    let of_voxels = voxels.chunk_by(|a, b| a.0 >> shift == b.0 >> shift);
    of_voxels.map(mean).collect()
}

/// From where no encoder looks.
fn picture(gaussians: &Gaussians) -> Vec<[f32; 4]> {
    let camera = Camera::orbit(100.0, 30.0, 3.0, 45.0, 64, 64).unwrap();
    let drawn = render(gaussians, &camera, Background::WHITE, &Limits::default());
    drawn.unwrap().0.pixels
}
