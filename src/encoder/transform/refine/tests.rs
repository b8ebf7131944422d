use super::*;
use crate::encoder::transform::{Options, QualityTarget};
use crate::gaussians::learned::HeadsModel;
use crate::log::Log;
use crate::placement::Placement;

/// A sheet with the colour that `colour` gives each place of it.
fn sheet(colour: impl Fn(u32, u32) -> [u8; 3]) -> ColouredVoxels {
    let place = |i: u32| [i % 64, i / 64, 20 + i % 64 / 7];
    let mut voxels: Vec<_> = (0..4096)
        .map(|i| (morton::encode(place(i)), colour(i % 64, i / 64)))
        .collect();
    voxels.sort_unstable();
    ColouredVoxels {
        voxels: Voxels::from_sorted(6, voxels.iter().map(|voxel| voxel.0).collect()),
        colours: voxels.iter().map(|voxel| voxel.1).collect(),
        placement: Placement::VOXEL_GRID,
    }
}

/// Stripes that are about as wide as voxels of level 5.
fn stripes() -> ColouredVoxels {
    sheet(|x, y| [(x * x % 5 * 50) as u8, (y / 3 % 2 * 200) as u8, 90])
}

fn options(tune: Tune) -> Options {
    Options {
        levels: Some(4..=5),
        fineness: QualityTarget::Step(8.0),
        tune,
        ..Options::default()
    }
}

/// Mean squared difference of what is drawn of a stream to the cloud, at the cloud's points.
fn difference_of(cloud: &ColouredVoxels, tune: Tune) -> f32 {
    let options = options(tune);
    let input = EncoderInput::new(cloud, 4..=5, &options, &Log::off()).unwrap();
    let steps = options.fineness.steps().unwrap();
    let coded = input.code(5, steps, None, &Log::off()).unwrap();
    let gaussians = input.drawn(&coded).unwrap();
    let surface = Surface::new(cloud, input.octree.level(5), &input.maps[5], &gaussians);
    let points = (0..surface.map.len()).flat_map(|voxel| {
        let points = range(&surface.first_point, voxel);
        points.map(move |i| (voxel, i))
    });
    let missing = |voxel, i: usize| surface.missing(&surface.map.row(voxel), &surface.points[i]).0;
    let squares = points.map(|(voxel, i)| missing(voxel, i).map(|x| x * x));
    squares.flatten().sum::<f32>() / surface.points.len() as f32
}

#[test]
fn what_is_drawn_is_what_a_decoder_makes_of_the_stream() {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("models/heads.safetensors");
    let model = HeadsModel::open(&path).unwrap();
    let cloud = stripes();
    for (top, lambda) in [(0, 0), (1, 0), (4, 0), (5, 25), (6, 25)] {
        for heads in [None, Some(&model)] {
            let options = Options {
                heads: heads.cloned(),
                ..options(Tune::Visual)
            };
            let input = EncoderInput::new(&cloud, top.min(4)..=top, &options, &Log::off()).unwrap();
            let steps = options.fineness.steps().unwrap();
            let shape = input.shape(top, lambda, &Log::off()).unwrap();
            assert_eq!(shape.is_some(), lambda > 0);
            let coded = input.code(top, steps, shape, &Log::off()).unwrap();
            let mut decoder = Decoder::new().with_level(top);
            if let Some(heads) = heads.filter(|_| top > 0) {
                decoder = decoder.with_heads_model(heads.clone()).with_heads(HeadSet::Best);
            }
            let decoded = decoder.decode(&coded.bytes).unwrap();
            assert!(input.drawn(&coded).unwrap() == decoded, "level {top}");
        }
    }
}

#[test]
fn what_is_drawn_is_nearer_to_the_cloud_than_with_mean_colours() {
    let [visual, mean] = [Tune::Visual, Tune::Psnr].map(|tune| difference_of(&stripes(), tune));
    assert!(visual < 0.9 * mean, "{visual} {mean}");
}

#[test]
fn one_colour_everywhere_needs_no_moves() {
    let cloud = sheet(|_, _| [90, 140, 30]);
    let coded = |tune| {
        let encoded = crate::encoder::transform::encode(&cloud, &options(tune), &Log::off());
        encoded.unwrap().bytes
    };
    assert!(coded(Tune::Visual) == coded(Tune::Psnr));
}

#[test]
fn grey_stays_grey() {
    let cloud = sheet(|x, y| [(x * 37 % 11 * y % 256) as u8; 3]);
    let options = options(Tune::Visual);
    let input = EncoderInput::new(&cloud, 4..=5, &options, &Log::off()).unwrap();
    let coded = input
        .code(5, options.fineness.steps().unwrap(), None, &Log::off())
        .unwrap();
    let moves = input.moves(&coded).unwrap();
    assert!(moves.by.iter().all(|by| by[1..] == [0.0, 0.0]));
}

#[test]
fn every_gaussian_belongs_to_the_nearest_voxel_around_its_place() {
    let voxels = Voxels::from_sorted(4, vec![morton::encode([3, 3, 3]), morton::encode([4, 3, 3])]);
    assert_eq!(owner(&voxels, [3.9, 3.2, 3.5]), Some(0));
    assert_eq!(owner(&voxels, [4.1, 4.2, 3.5]), Some(1));
    assert_eq!(owner(&voxels, [2.9, 2.2, 3.5]), Some(0));
    assert_eq!(owner(&voxels, [8.0, 3.0, 3.0]), None);
    assert_eq!(owner(&voxels, [f32::NAN, -4.0, 1e30]), None);
}
