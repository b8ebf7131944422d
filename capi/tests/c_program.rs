//! A C program built against the header and the static library: it runs, with AddressSanitizer watching where the
//! compiler has it, and draws what Rust draws.

#[path = "../../tests/common/mod.rs"]
mod common;

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use b2p::encoder::transform;
use b2p::gaussians::Heads;
use b2p::latents::LatentDecoder;
use b2p::latents::network::{Model, Shape, untrained};
use b2p::log::Log;
use b2p::renderer::camera::Camera;
use b2p::renderer::{Background, render};
use b2p::{Decoder, SceneDecoder, SceneReader, Voxels, Wanted};

/// Where cargo put the static library: beside this test, or a folder above.
fn library() -> PathBuf {
    let test = std::env::current_exe().expect("a path");
    let found = test
        .ancestors()
        .skip(1)
        .take(2)
        .map(|folder| folder.join("libb2p_c.a"))
        .find(|library| library.exists());
    found.expect("the static library is built with the test")
}

fn compile(source: &str, to: &Path, more: &[&str]) -> Output {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    Command::new("cc")
        .args(["-std=c11", "-Wall", "-Wextra", "-Werror", "-O1", "-g"])
        .args(more)
        .arg("-I")
        .arg(here.join("include"))
        .arg(here.join(source))
        .arg(library())
        .args(["-lpthread", "-ldl", "-lm", "-o"])
        .arg(to)
        .output()
        .expect("a C compiler")
}

#[track_caller]
fn printed(output: Output) -> String {
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{errors}");
    String::from_utf8(output.stdout).expect("text")
}

/// A small scene of blocks.
fn conformance_scene() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/data/conformance/scenes/ball.b2p")
}

/// A sum over coordinates and colours, as the C program makes it.
fn sum_of(voxels: &Voxels, colours: &[[u8; 3]]) -> u64 {
    let coordinates = (0..voxels.len()).flat_map(|i| voxels.coordinate(i));
    let colours = colours.as_flattened().iter().map(|c| u32::from(*c));
    let sum = coordinates.zip(colours).flat_map(|(c, colour)| [c, colour]);
    sum.fold(0u64, |sum, x| sum.wrapping_mul(31).wrapping_add(x.into()))
}

#[test]
fn a_c_program_decodes_and_draws_as_rust_does() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    let file = common::tiny_model(0);
    let model = Model::from_bytes(&file).expect("a model");
    let stream = common::small_stream(&model);
    let file_of_both = untrained(&Shape::tiny().with_quick_heads(), 0);
    let both = Model::from_bytes(&file_of_both).expect("a model");
    std::fs::write(at("model"), &file).expect("written");
    std::fs::write(at("both"), &file_of_both).expect("written");
    std::fs::write(at("stream"), &stream).expect("written");
    let cloud = common::Ball::new(4, 4.5).cloud();
    let (options, log) = (transform::Options::default(), &Log::default());
    let new = transform::encode(&cloud, &options, log).expect("a ball can be coded");
    std::fs::write(at("new"), &new.bytes).expect("written");

    let camera = Camera::orbit(20.0, 10.0, 3.0, 45.0, 40, 30).expect("a camera");
    let limits = b2p::Limits::default();
    let sum = |model: &Model, heads| {
        let decoder = LatentDecoder::new(model).with_heads(heads).expect("heads");
        let gaussians = decoder.decode(&stream, None, &Log::default());
        let gaussians = gaussians.expect("a stream");
        let drawn = render(&gaussians, &camera, Background::WHITE, &limits);
        let picture = drawn.expect("a picture").0.to_pixmap().expect("bytes");
        let sum = |sum: u64, byte: &u8| sum.wrapping_mul(31).wrapping_add(u64::from(*byte));
        picture.data().iter().fold(0, sum)
    };
    let (best, quick) = (sum(&model, Heads::Best), sum(&both, Heads::Quick));
    assert_ne!(best, quick);
    let decoding = Decoder::new().whole(&new.bytes);
    let decoding = decoding.expect("a stream");
    let points = decoding.points().expect("points");
    let sum = sum_of(points.voxels, points.colours);
    let points = format!("{} {sum:016x}\n", points.voxels.len());
    let blocks = std::fs::read(conformance_scene()).expect("a scene");
    let scene = SceneReader::new(&blocks[..], &limits).expect("a scene");
    let decoded = SceneDecoder::new(Decoder::new()).voxels(&scene, &Wanted::All);
    let (voxels, colours) = decoded.expect("voxels").whole().expect("no damage");
    let blocks = format!("{} {:016x}\n", voxels.len(), sum_of(&voxels, &colours));
    let expected = format!("{blocks}{points}{best:016x}\n{quick:016x}\n");

    let sanitizers = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"];
    printed(compile("tests/use.c", &at("plain"), &[]));
    let mut programs = vec![("alone", Command::new(at("plain")))];
    match compile("tests/use.c", &at("watched"), &sanitizers).status.success() {
        true => programs.push(("with sanitizers", Command::new(at("watched")))),
        false => println!("NOT RUN: this compiler has no AddressSanitizer"),
    }
    if Command::new("valgrind").arg("--version").output().is_ok() {
        let mut valgrind = Command::new("valgrind");
        valgrind.args(["-q", "--error-exitcode=9", "--leak-check=full"]);
        valgrind.args(["--errors-for-leak-kinds=definite"]).arg(at("plain"));
        programs.push(("under valgrind", valgrind));
    } else {
        println!("NOT RUN: there is no valgrind");
    }
    assert!(programs.len() > 1, "nothing here watches a program's memory");
    for (how, mut program) in programs {
        program.args([at("model"), at("stream"), at("both"), at("new"), conformance_scene()]);
        let output = program.output().expect("the program starts");
        assert_eq!(printed(output), expected, "{how}");
        println!("ran {how}");
    }
}

#[test]
fn the_example_in_c_decodes_the_sample_scene_and_draws_it() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    printed(compile("examples/decode.c", &at("decode"), &[]));
    let scene = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models/scene.b2p");
    let mut example = Command::new(at("decode"));
    let text = printed(example.arg(scene).arg(at("scene.ppm")).output().expect("it starts"));
    assert!(
        text.contains("level 7 is complete") && text.contains(" Gaussians"),
        "{text}"
    );
    let picture = std::fs::read(at("scene.ppm")).expect("a picture");
    assert_eq!(picture.len(), "P6\n640 480\n255\n".len() + 3 * 640 * 480);
}
