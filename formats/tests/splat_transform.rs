//! Files there and back through another program, splat-transform of PlayCanvas: what we write means to it what our PLY
//! means, and what it writes means to us what its input did. Run by `tests/splat_transform.sh`, which installs it.

use std::path::{Path, PathBuf};
use std::process::Command;

use b2p::gaussians::{Frame, Gaussians};
use b2p::{Limits, Placement, Up};
use b2p_formats::splats::{Axes, Format, Options, Splats, read, write};

/// The program's main file, which Node runs.
const VARIABLE: &str = "B2P_SPLAT_TRANSFORM";

/// A Gaussian in the world.
#[derive(Debug, Clone)]
struct Splat {
    position: [f64; 3],
    log_scale: [f64; 3],
    rotation: [f64; 4],
    opacity: f64,
    colour: [f64; 3],
    harmonics: Vec<f32>,
}

/// Largest errors that two quantisations may leave: of the format, there and back.
struct Tolerance {
    position: f64,
    log_scale: f64,
    rotation: f64,
    opacity: f64,
    colour: f64,
    harmonics: f32,
}

fn tolerance(format: Format) -> Tolerance {
    // Positions are within ±4; logarithms of scales span 4.
    let float = Tolerance {
        position: 4e-6,
        log_scale: 1e-5,
        rotation: 1e-5,
        opacity: 1e-5,
        colour: 1e-5,
        harmonics: 1e-5,
    };
    let byte = 1.0 / 255.0 + 1e-5;
    match format {
        Format::CompressedPly => Tolerance {
            position: 8.0 / 1023.0,
            log_scale: 4.0 / 1023.0,
            rotation: 4e-3,
            opacity: byte,
            colour: byte,
            harmonics: 8.0 / 256.0 + 1e-4,
        },
        Format::Spz => Tolerance {
            // The other program writes 12 bits after the point.
            position: 1.0 / 4096.0,
            log_scale: 1.0 / 16.0,
            rotation: 4e-3,
            opacity: byte,
            colour: 1.0 / 255.0 / 0.15 * 0.2821,
            harmonics: 8.6 / 128.0,
        },
        Format::Sog => Tolerance {
            position: 5.0 * 3.3 / 65535.0,
            log_scale: 4.0 / 100.0,
            rotation: 1.6e-2,
            opacity: byte,
            colour: 2e-2,
            harmonics: 0.02,
        },
        Format::Splat => Tolerance {
            rotation: 2e-2,
            opacity: byte,
            colour: byte,
            ..float
        },
        _ => float,
    }
}

/// A lopsided cloud, so that a mirrored or turned one is another.
fn sample(count: usize, harmonics: usize) -> Gaussians {
    let mut state = 7u32;
    let mut random = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 24) as f32
    };
    let mut g = Gaussians {
        frame: Frame {
            bits: 10,
            placement: Placement {
                origin: [-1.0, 0.0, 2.0],
                voxel_size: 2.0 / 1024.0,
            },
        },
        ..Gaussians::default()
    };
    for i in 0..count {
        g.position.push([random() * 1.8 - 0.9, random() - 0.9, random() * 0.3]);
        g.scale.push([0; 3].map(|_| (-4.0 * random() - 2.0).exp()));
        g.rotation.push([0; 4].map(|_| random() - 0.5));
        g.opacity.push([1.0, random(), 0.5][i % 3]);
        g.colour.push([0; 3].map(|_| random()));
    }
    // Few of them, which a palette holds exactly.
    let few: Vec<[f32; 3]> = (0..5 * harmonics)
        .map(|_| [0; 3].map(|_| 0.8 * random() - 0.4))
        .collect();
    let own = |i: usize| few[i % 5 * harmonics..][..harmonics].to_vec();
    g.harmonics.coefficients = (0..count).flat_map(own).collect();
    g.harmonics.count = harmonics;
    g
}

fn world(g: &Gaussians) -> Vec<Splat> {
    let of = |i: usize| {
        let norm = g.rotation[i].iter().map(|q| f64::from(*q).powi(2)).sum::<f64>().sqrt();
        let count = g.harmonics.count;
        Splat {
            position: g.frame.placement.from_cube(g.frame.bits, g.position[i]),
            log_scale: g.scale[i].map(|s| (f64::from(s) * g.frame.unit()).ln()),
            rotation: g.rotation[i].map(|q| f64::from(q) / norm),
            opacity: g.opacity[i].into(),
            colour: g.colour[i].map(f64::from),
            harmonics: g.harmonics.coefficients[i * count..][..count].as_flattened().to_vec(),
        }
    };
    (0..g.len()).map(of).collect()
}

/// Holds `after` to being `before` in any order.
fn assert_alike(before: &Gaussians, after: &Gaussians, limits: &Tolerance, what: &str) {
    assert_eq!(before.len(), after.len(), "{what}");
    let after = world(after);
    let near = |a: &[f64], b: &[f64], tolerance: f64| a.iter().zip(b).all(|(a, b)| (a - b).abs() <= tolerance);
    let mut taken = vec![false; after.len()];
    for a in world(before) {
        let distance = |b: &Splat| {
            let square = |x: &[f64], y: &[f64]| x.iter().zip(y).map(|(x, y)| (x - y).powi(2)).sum::<f64>();
            square(&a.position, &b.position) + square(&a.colour, &b.colour)
        };
        let nearest = (0..after.len())
            .min_by(|&i, &j| distance(&after[i]).total_cmp(&distance(&after[j])))
            .unwrap();
        assert!(!taken[nearest], "{what}: two for {a:?}");
        taken[nearest] = true;
        let b = &after[nearest];
        assert!(
            near(&a.position, &b.position, limits.position),
            "{what}: position of {a:?} {b:?}"
        );
        assert!(
            near(&a.log_scale, &b.log_scale, limits.log_scale),
            "{what}: scale of {a:?} {b:?}"
        );
        let dot: f64 = (0..4).map(|k| a.rotation[k] * b.rotation[k]).sum();
        let turned = b.rotation.map(|q| q * dot.signum());
        assert!(
            near(&a.rotation, &turned, limits.rotation),
            "{what}: rotation of {a:?} {b:?}"
        );
        assert!(
            near(&[a.opacity], &[b.opacity], limits.opacity),
            "{what}: opacity of {a:?} {b:?}"
        );
        assert!(
            near(&a.colour, &b.colour, limits.colour),
            "{what}: colour of {a:?} {b:?}"
        );
        assert_eq!(a.harmonics.len(), b.harmonics.len(), "{what}");
        let rest = a.harmonics.iter().zip(&b.harmonics);
        assert!(
            rest.into_iter().all(|(a, b)| (a - b).abs() <= limits.harmonics),
            "{what}: harmonics of {a:?} {b:?}"
        );
    }
}

struct Program {
    main: PathBuf,
    folder: PathBuf,
}

impl Program {
    fn run(&self, arguments: &[&str]) {
        let mut command = Command::new("node");
        let done = command
            .arg(&self.main)
            .args(["-q", "-w", "-g", "cpu"])
            .args(arguments)
            .current_dir(&self.folder);
        let done = done.output().unwrap();
        let said = String::from_utf8_lossy(&done.stderr);
        assert!(done.status.success(), "splat-transform {arguments:?}: {said}");
    }

    fn write(&self, g: &Gaussians, axes: Axes, format: Format, name: &str) {
        let mut bytes = Vec::new();
        write(g, axes, format, &mut bytes, Path::new(name)).unwrap();
        std::fs::write(self.folder.join(name), bytes).unwrap();
    }

    fn read(&self, format: Format, name: &str) -> Splats {
        let bytes = std::fs::read(self.folder.join(name)).unwrap();
        assert!(
            matches!(Format::of_bytes(&bytes), Some(found) if found == format) || format == Format::Splat,
            "{name}"
        );
        read(&bytes, format, &Options::default(), &Limits::default()).unwrap()
    }
}

#[test]
fn files_mean_the_same_to_splat_transform() {
    let Some(main) = std::env::var_os(VARIABLE) else {
        println!("skipped: {VARIABLE} names no splat-transform (tests/splat_transform.sh installs it)");
        return;
    };
    let folder = std::env::temp_dir().join(format!("b2p-splat-transform-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let program = Program {
        main: main.into(),
        folder: folder.clone(),
    };
    for harmonics in [0, 3, 15] {
        let before = sample(300, harmonics);
        program.write(&before, Axes::Ply, Format::Ply, "plain.ply");
        for format in Format::all() {
            there_and_back(&program, &before, format, harmonics);
        }
    }
    clouds_stand_upright(&program);
    std::fs::remove_dir_all(folder).unwrap();
}

/// The other program makes glTF of our files of a cloud with z up: there y is up.
fn clouds_stand_upright(program: &Program) {
    let before = sample(300, 0);
    for format in [
        Format::Ply,
        Format::CompressedPly,
        Format::Spz,
        Format::Sog,
        Format::Splat,
    ] {
        let name = format!("up{}", format.extension());
        program.write(&before, Axes::Cloud(Up::Z), format, &name);
        program.run(&[&name, "up.glb"]);
        let there = program.read(Format::Glb, "up.glb");
        assert_eq!(there.axes, Axes::Gltf, "{format}");
        let places: Vec<[f64; 3]> = world(&there.gaussians).iter().map(|splat| splat.position).collect();
        let most = tolerance(format).position;
        for Splat {
            position: [x, y, z], ..
        } in world(&before)
        {
            let expected = [x, z, -y];
            let near = |p: &[f64; 3]| (0..3).all(|k| (p[k] - expected[k]).abs() <= most);
            assert!(places.iter().any(near), "{format}: nothing at {expected:?}");
        }
        // What we make of it lies as the cloud does.
        program.write(&there.gaussians, Axes::Gltf, Format::Ply, "down.ply");
        let down = program.read(Format::Ply, "down.ply").gaussians;
        let lowest = |g: &Gaussians, k: usize| world(g).iter().map(|s| s.position[k]).fold(f64::INFINITY, f64::min);
        let highest = world(&before)
            .iter()
            .map(|s| s.position[2])
            .fold(f64::NEG_INFINITY, f64::max);
        assert!((lowest(&down, 1) + highest).abs() <= most, "{format}: −y is up");
    }
}

fn there_and_back(program: &Program, before: &Gaussians, format: Format, harmonics: usize) {
    let name = |stem: &str| format!("{stem}{}", format.extension());
    let what = format!("{format} with {harmonics} harmonics");
    let plain = if format == Format::Splat {
        without_harmonics(before)
    } else {
        before.clone()
    };
    let limits = tolerance(format);
    // What we write, it reads.
    if !matches!(format, Format::Glb | Format::Gltf | Format::Csv | Format::Npz) {
        program.write(before, Axes::Ply, format, &name("ours"));
        program.run(&[&name("ours"), "back.ply"]);
        let back = program.read(Format::Ply, "back.ply").gaussians;
        assert_alike(&plain, &back, &limits, &format!("{what}, written by us"));
    }
    // What it writes, we read.
    if !matches!(format, Format::Splat | Format::Gltf | Format::Npz) {
        program.run(&["plain.ply", &name("theirs")]);
        let mut theirs = program.read(format, &name("theirs"));
        if theirs.axes == Axes::Gltf {
            program.write(&theirs.gaussians, Axes::Gltf, Format::Ply, "turned.ply");
            theirs = program.read(Format::Ply, "turned.ply");
        }
        assert_alike(&plain, &theirs.gaussians, &limits, &format!("{what}, written by it"));
    }
    if format == Format::Spz {
        program.run(&["plain.ply", "--spz-version", "3", "old.spz"]);
        let old = program.read(format, "old.spz").gaussians;
        assert_alike(&plain, &old, &limits, &format!("{what}, version 3"));
    }
}

fn without_harmonics(g: &Gaussians) -> Gaussians {
    Gaussians {
        harmonics: Default::default(),
        ..g.clone()
    }
}
