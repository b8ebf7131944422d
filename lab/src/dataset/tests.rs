use super::*;
use crate::mesh::fixtures::{quad, texture};

/// A box of 1 × 1 × 1 with a chequered skin.
fn cube() -> Mesh {
    let skin = || {
        Some(texture(32, 32, |x, y| {
            [(x * 8) as u8, (y * 8) as u8, ((x + y) % 2 * 200) as u8, 255]
        }))
    };
    let (x, y, z) = ([1., 0., 0.], [0., 1., 0.], [0., 0., 1.]);
    Mesh {
        parts: vec![
            quad([0.; 3], x, y, skin()),
            quad([0.; 3], y, z, skin()),
            quad([0.; 3], z, x, skin()),
            quad(z, x, y, skin()),
            quad(x, y, z, skin()),
            quad(y, z, x, skin()),
        ],
    }
}

fn options() -> Options {
    Options {
        count: 3,
        seed: 5,
        bits: 6,
        crop: 32,
        views: 2,
        size: 40,
        supersampling: 3,
        noisy: 0.0,
    }
}

fn objects() -> Vec<Object> {
    vec![
        Object::new("cube".into(), &cube()),
        Object::new("tds_cube".into(), &cube()),
    ]
}

fn photos() -> Vec<Photo> {
    let picture = texture(16, 16, |x, y| [200, (x * 9) as u8, (y * 13) as u8, 255]);
    vec![(Arc::new(Pyramid::new(&picture)), 1.0)]
}

fn files(folder: &Path) -> Vec<(String, Vec<u8>)> {
    let mut files: Vec<_> = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .map(|path| {
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            (name, std::fs::read(&path).unwrap())
        })
        .collect();
    files.sort();
    files
}

fn made(options: &Options, threads: usize) -> Vec<(String, Vec<u8>)> {
    let folder = tempfile::tempdir().unwrap();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
    let written = pool
        .build()
        .unwrap()
        .install(|| write(folder.path(), &objects(), &photos(), options, || ()))
        .unwrap();
    let files = files(folder.path());
    assert_eq!(files.len(), written);
    files
}

#[test]
fn samples_depend_on_the_seed_alone_not_on_threads_or_how_many_are_made() {
    let three = made(&options(), 1);
    assert_eq!(three.len(), 3);
    assert_eq!(three, made(&options(), 4));
    let one = made(&Options { count: 1, ..options() }, 1);
    assert_eq!(one[0], three[0]);
    let other = made(&Options { seed: 6, ..options() }, 1);
    assert_ne!(other, three);
}

#[test]
fn no_sample_is_noisy_unless_asked_for_and_then_its_voxels_differ() {
    let voxels = |noisy: f64| -> Vec<Vec<u8>> {
        let samples = made(&Options { noisy, ..options() }, 1);
        let finest = samples.iter().map(|(_, bytes)| {
            let file = safetensors::SafeTensors::deserialize(bytes).unwrap();
            file.tensor("xyz.3").unwrap().data().to_vec()
        });
        finest.collect()
    };
    let exact = voxels(0.0);
    assert_eq!(exact, voxels(1e-300));
    for (noisy, exact) in voxels(1.0).iter().zip(&exact) {
        assert_ne!(noisy, exact);
    }
}

#[test]
fn a_samples_levels_fit_together_and_its_pictures_show_its_voxels() {
    for (name, bytes) in made(&options(), 2) {
        let file = safetensors::SafeTensors::deserialize(&bytes).unwrap();
        let ints = |tensor: &str| -> Vec<i32> {
            let data = file.tensor(tensor).unwrap().data().to_vec();
            let (words, _) = data.as_chunks::<4>();
            words.iter().map(|b| i32::from_le_bytes(*b)).collect()
        };
        for role in 1..=3 {
            let (xyz, above) = (ints(&format!("xyz.{role}")), ints(&format!("xyz.{}", role - 1)));
            let (xyz, above) = (xyz.as_chunks::<3>().0, above.as_chunks::<3>().0);
            let parent = ints(&format!("parent.{role}"));
            assert_eq!(parent.len(), xyz.len());
            for (v, p) in xyz.iter().zip(parent) {
                assert_eq!(v.map(|x| x >> 1), above[p as usize]);
            }
        }
        let finest = ints("xyz.3");
        let finest = finest.as_chunks::<3>().0;
        assert!(finest.iter().flatten().all(|x| (0..32).contains(x)));
        assert_eq!(file.tensor("rgb").unwrap().shape(), [finest.len(), 3]);

        let cameras = file.tensor("camera").unwrap();
        assert_eq!(cameras.shape(), [2, 16]);
        let (words, _) = cameras.data().as_chunks::<4>();
        let numbers: Vec<f32> = words.iter().map(|b| f32::from_le_bytes(*b)).collect();
        let image = file.tensor("image").unwrap();
        assert_eq!(image.shape(), [2, 40, 40, 4]);
        let pixels = image.data().as_chunks::<4>().0;
        assert!(
            pixels
                .iter()
                .all(|p| p[..3].iter().all(|c| *c <= p[3].saturating_add(1)))
        );
        let mut on_picture = 0;
        for (c, pixels) in numbers.chunks(16).zip(pixels.chunks(40 * 40)) {
            for &v in finest {
                let Some((pixel, _)) = project(c, v) else {
                    continue;
                };
                let (x, y) = (pixel as i32 % 40, pixel as i32 / 40);
                if !(2..38).contains(&x) || !(2..38).contains(&y) {
                    continue;
                }
                // A voxel's centre is up to 0.87 voxels, which is less than two and a half pixels, from its surface.
                let near = (y - 2..=y + 2).flat_map(|y| (x - 2..=x + 2).map(move |x| 40 * y + x));
                assert!(
                    near.into_iter().any(|i| pixels[i as usize][3] > 0),
                    "{name}: nothing at {x}, {y}"
                );
                on_picture += 1;
            }
        }
        assert!(on_picture > finest.len(), "{name}: {on_picture}");
    }
}

/// The pixel of a 40 × 40 picture that a voxel's centre falls on, and how far away it is.
fn project(camera: &[f32], voxel: [i32; 3]) -> Option<(usize, f32)> {
    let p = voxel.map(|x| x as f32 + 0.5);
    let q: [f32; 3] = std::array::from_fn(|i| {
        let row = &camera[3 * i..3 * i + 3];
        row[0] * p[0] + row[1] * p[1] + row[2] * p[2] + camera[9 + i]
    });
    let x = (camera[12] * q[0] / q[2] + camera[14]).floor();
    let y = (camera[13] * q[1] / q[2] + camera[15]).floor();
    let inside = |v: f32| (0.0..40.0).contains(&v);
    (inside(x) && inside(y)).then_some(((40.0 * y + x) as usize, q[2]))
}

#[test]
fn a_samples_pictures_have_the_colours_of_its_voxels() {
    let options = Options { count: 8, ..options() };
    let photographs = made(&options, 2);
    let photographs = photographs.iter().filter(|(name, _)| name.contains("tds_"));
    let mut samples = 0;
    for (name, bytes) in photographs {
        let file = safetensors::SafeTensors::deserialize(bytes).unwrap();
        let data = |tensor: &str| file.tensor(tensor).unwrap().data().to_vec();
        let words = |tensor: &str| data(tensor).as_chunks::<4>().0.to_vec();
        let xyz: Vec<i32> = words("xyz.3").into_iter().map(i32::from_le_bytes).collect();
        let cameras: Vec<f32> = words("camera").into_iter().map(f32::from_le_bytes).collect();
        let (rgb, pixels) = (data("rgb"), words("image"));
        let (rgb, xyz) = (rgb.as_chunks::<3>().0, xyz.as_chunks::<3>().0);
        let mut differences = Vec::new();
        for (camera, pixels) in cameras.chunks(16).zip(pixels.chunks(40 * 40)) {
            let mut nearest = vec![(f32::INFINITY, [0; 3]); 40 * 40];
            for (&voxel, &colour) in xyz.iter().zip(rgb) {
                if let Some((pixel, depth)) = project(camera, voxel)
                    && depth < nearest[pixel].0
                {
                    nearest[pixel] = (depth, colour);
                }
            }
            let seen = pixels.iter().zip(nearest);
            let seen = seen.filter(|(p, (depth, _))| p[3] == 255 && depth.is_finite());
            differences.extend(seen.flat_map(|(p, (_, c))| (0..3).map(move |i| p[i].abs_diff(c[i]))));
        }
        differences.sort_unstable();
        let median = differences[differences.len() / 2];
        assert!(median <= 8, "{name}: half of the pixels are off by {median}");
        samples += 1;
    }
    assert!(samples >= 2, "{samples} samples with a photograph");
}

#[test]
fn people_come_up_twice_a_round_and_the_rest_once() {
    let mesh = cube();
    let objects: Vec<Object> = ["bowl", "person_a", "tds_a"]
        .map(|name| Object::new(name.into(), &mesh))
        .into();
    for round in 0..3 {
        let mut counts = [0; 3];
        for index in 4 * round..4 * round + 4 {
            counts[turn(&objects, 1, index, 0)] += 1;
        }
        assert_eq!(counts, [1, 2, 1]);
    }
}

#[test]
fn crops_of_no_use_are_refused() {
    assert!(crop::is_sensible(6_000, 128) && !crop::is_sensible(5_999, 128));
    assert!(crop::is_sensible(70_000, 128) && !crop::is_sensible(70_001, 128));
    let bad = Options { crop: 100, ..options() };
    let folder = tempfile::tempdir().unwrap();
    assert!(write(folder.path(), &objects(), &[], &bad, || ()).is_err());
    assert!(write(folder.path(), &[], &[], &options(), || ()).is_err());
}
