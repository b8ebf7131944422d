use super::*;
use crate::cloud::ColouredVoxels;
use crate::encoder::transform::{Options, QualityTarget, Tune, encode, encode_to_rate};
use crate::geometry::morton;
use crate::placement::Placement;

/// A box in 32³ with a smaller one in it, with stripes around them.
fn walls() -> ColouredVoxels {
    let all = (0..1 << 15u64).map(|key| (key, morton::decode(key)));
    let kept: Vec<_> = all
        .filter(|(_, at)| {
            let depth = at.iter().map(|&x| x.min(31 - x)).min().unwrap_or(0);
            depth == 2 || depth == 8
        })
        .collect();
    let colour = |[x, y, z]: [u32; 3]| [(x * x % 5 * 50) as u8, (y / 3 % 2 * 200) as u8, (z * 8) as u8];
    ColouredVoxels {
        voxels: Voxels::from_sorted(5, kept.iter().map(|voxel| voxel.0).collect()),
        colours: kept.iter().map(|voxel| colour(voxel.1)).collect(),
        placement: Placement::VOXEL_GRID,
    }
}

fn options(rounds: usize) -> Options {
    Options {
        levels: Some(3..=4),
        fineness: QualityTarget::Step(12.0),
        rounds,
        ..Options::default()
    }
}

/// What is coded of the cloud, and the squared error of its pictures.
fn error_of(cloud: &ColouredVoxels, options: &Options) -> f64 {
    let input = EncoderInput::new(cloud, 3..=4, options, &Log::off()).unwrap();
    let steps = options.fineness.steps().unwrap();
    let coded = input.code(4, steps, None, &Log::off()).unwrap();
    let pictures = input.draw_all().unwrap();
    let gaussians = input.drawn(&coded).unwrap();
    let mut views = input.views();
    let errors = directions().zip(&pictures.views).map(|(direction, truth)| {
        let seen = views.large(&gaussians, direction).unwrap();
        squared_error(&missing(truth, &seen))
    });
    errors.sum()
}

#[test]
fn rounds_bring_pictures_nearer_to_those_of_the_cloud() {
    let cloud = walls();
    let [none, one, four] = [0, 1, 4].map(|rounds| error_of(&cloud, &options(rounds)));
    assert!(one < none && four < 0.95 * none, "{none}, {one}, {four}");
}

#[test]
fn what_hides_behind_walls_is_seen_less() {
    let (cloud, options) = (walls(), options(1));
    let input = EncoderInput::new(&cloud, 3..=5, &options, &Log::off()).unwrap();
    let steps = options.fineness.steps().unwrap();
    let coded = input.code(5, steps, None, &Log::off()).unwrap();
    let told = input.compare(input.pictures(&Log::off()).unwrap(), &coded).unwrap();
    // Means of the walls of both boxes, away from edges.
    let mean_of = |wall: [u32; 2]| {
        let voxels = cloud.voxels.keys().iter().map(|key| morton::decode(*key));
        let seen = voxels.zip(&told.seen).filter_map(|(at, seen)| {
            let inside = at.iter().filter(|x| (10..22).contains(*x)).count();
            (inside == 2 && at.iter().any(|x| wall.contains(x))).then_some(*seen)
        });
        let seen: Vec<u64> = seen.collect();
        seen.iter().sum::<u64>() as f64 / seen.len() as f64
    };
    let [outer, inner] = [mean_of([2, 29]), mean_of([8, 23])];
    assert!(inner < 0.05 * outer, "{inner} and {outer}");
}

#[test]
fn the_stream_is_the_same_for_any_number_of_threads() {
    let cloud = walls();
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| encode(&cloud, &options(2), &Log::off()).unwrap().bytes)
    };
    assert!(with(1) == with(3));
}

#[test]
fn mean_and_exact_colours_have_no_rounds() {
    let cloud = walls();
    let mean = Options {
        tune: Tune::Psnr,
        ..options(0)
    };
    let exact = Options {
        fineness: QualityTarget::Lossless,
        ..options(0)
    };
    for usual in [mean, exact] {
        let rounds = Options {
            rounds: 3,
            ..usual.clone()
        };
        let coded = |options| encode(&cloud, options, &Log::off()).unwrap().bytes;
        assert!(coded(&usual) == coded(&rounds));
    }
}

#[test]
fn a_stream_of_a_rate_fits_it_and_is_that_of_its_options() {
    let cloud = walls();
    let off = Log::off();
    for most in [0.6, 1.2, 3.0] {
        let (encoded, chosen) = encode_to_rate(&cloud, &options(2), most, &off).unwrap();
        assert!(encoded.bytes.len() as f64 * 8.0 <= most * cloud.voxels.len() as f64);
        assert!(
            encode(&cloud, &chosen, &off).unwrap().bytes == encoded.bytes,
            "{most}: {chosen:?}"
        );
    }
}
