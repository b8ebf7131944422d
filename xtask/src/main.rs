//! Regenerates generated files that are kept in the repository: `cargo xtask conformance`, `damage`, `seeds` or
//! `sample`.
//!
//! Tests compare with these files and never write them. What streams a suite has is defined beside its test.

#[path = "../../tests/common/mod.rs"]
mod common;
mod damage;
#[path = "../../tests/conformance/digest.rs"]
#[allow(dead_code, reason = "the test decodes in pieces, too")]
mod digest;
#[path = "../../tests/conformance/digest_scene.rs"]
mod digest_scene;
#[path = "../../tests/conformance/digest_sequence.rs"]
mod digest_sequence;
#[path = "../../tests/conformance/digest_transform.rs"]
#[allow(dead_code, reason = "the test decodes in pieces, too")]
mod digest_transform;
#[path = "../../tests/conformance/heads.rs"]
mod heads;
#[path = "../../tests/conformance/make.rs"]
#[allow(dead_code, reason = "the test knows which streams every machine makes alike")]
mod make;
#[path = "../../tests/conformance/make_scene.rs"]
mod make_scene;
#[path = "../../tests/conformance/make_sequence.rs"]
mod make_sequence;
#[path = "../../tests/conformance/make_transform.rs"]
mod make_transform;
#[path = "../../tests/conformance/models.rs"]
mod models;
#[path = "../../tests/common/seal.rs"]
mod seal;

use std::error::Error;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

use b2p::gaussians::HeadSet;
use b2p::{Decoder, Isa};

type Result<T = ()> = std::result::Result<T, Box<dyn Error>>;

const USAGE: &str = "usage: cargo xtask TASK

conformance  writes the streams and digests of the conformance suites into tests/data/conformance, and the damage
scenes       writes those of the suite of scenes alone
sequences    writes those of the suite of sequences alone
heads        writes the learned heads of the suites, and the digests of all their streams drawn with them
damage       writes the list of damaged streams, tests/data/conformance/damage.txt
seeds        writes the seeds of the fuzz targets into fuzz/corpus
sample       renders the sample scene and codes it as models/scene.b2p and models/sample.b2p";

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let done = match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["conformance"] => conformance()
            .and_then(|()| conformance_transform())
            .and_then(|()| conformance_scenes())
            .and_then(|()| conformance_sequences())
            .and_then(|()| conformance_heads())
            .and_then(|()| damage()),
        ["scenes"] => conformance_scenes().and_then(|()| conformance_heads()),
        ["sequences"] => conformance_sequences().and_then(|()| conformance_heads()),
        ["heads"] => conformance_heads(),
        ["damage"] => damage(),
        ["seeds"] => cargo(&["run", "--locked", "-p", "b2p-fuzz", "--example", "seeds"]),
        ["sample"] => sample(),
        _ => Err(USAGE.into()),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}

/// The repository.
fn root() -> &'static Path {
    let own = Path::new(env!("CARGO_MANIFEST_DIR"));
    own.parent().unwrap_or(own)
}

fn suite() -> PathBuf {
    root().join("tests/data/conformance")
}

/// Writes the streams and digests of version 2.
fn conformance() -> Result {
    let (mut text, mut size) = (String::new(), 0);
    for case in make::cases() {
        let levels = digest::whole(&models::model(case.model), &case.bytes);
        let levels = levels.map_err(|error| format!("{}: {error}", case.name))?;
        text += &format!("{} {} {}\n", case.name, case.model, levels.join(" "));
        size += case.bytes.len();
        std::fs::write(suite().join(format!("{}.b2p", case.name)), case.bytes)?;
    }
    std::fs::write(suite().join("suite.txt"), &text)?;
    println!("version 2: {} streams, {size} bytes", text.lines().count());
    Ok(())
}

/// Writes the scenes and their digests, in place of all that are there.
fn conformance_scenes() -> Result {
    let decoder = Decoder::new().with_heads(HeadSet::Surfels);
    let (mut text, mut streams) = (String::new(), Vec::new());
    for (name, bytes, _) in make_scene::cases() {
        let parts = digest_scene::parts(&decoder, &bytes).map_err(|error| format!("{name}: {error}"))?;
        text += &digest_scene::lines(name, &parts);
        streams.push((name, bytes));
    }
    replace(&suite().join("scenes"), &streams, &text)?;
    println!("scenes: {}", streams.len());
    Ok(())
}

/// Writes the sequences and their digests, in place of all that are there.
fn conformance_sequences() -> Result {
    let decoder = Decoder::new().with_heads(HeadSet::Surfels);
    let (mut text, mut streams) = (String::new(), Vec::new());
    for (name, bytes, _) in make_sequence::cases() {
        let lines = digest_sequence::lines(&decoder, name, &bytes, false);
        text += &lines.map_err(|error| format!("{name}: {error}"))?;
        streams.push((name, bytes));
    }
    replace(&suite().join("sequences"), &streams, &text)?;
    println!("sequences: {}", streams.len());
    Ok(())
}

/// Writes the streams and digests of version 3, in place of all that are there.
fn conformance_transform() -> Result {
    let decoder = Decoder::new().with_heads(HeadSet::Surfels);
    let (mut text, mut streams) = (String::new(), Vec::new());
    for (name, bytes, _) in make_transform::cases() {
        let levels = digest_transform::whole(&decoder, &bytes).map_err(|error| format!("{name}: {error}"))?;
        text += &format!("{name} {}\n", levels.join(" "));
        streams.push((name, bytes));
    }
    replace(&suite().join("version-3"), &streams, &text)?;
    println!("version 3: {} streams", streams.len());
    Ok(())
}

/// Writes the learned heads of the suites of version 3, and digests of the streams that these have, drawn with them.
fn conformance_heads() -> Result {
    std::fs::write(suite().join("heads.safetensors"), heads::file())?;
    type Lines = fn(&Decoder, &str, &[u8]) -> b2p::Result<String>;
    let suites: [(&str, Lines); 3] = [
        ("version-3", |decoder, name, bytes| {
            let levels = digest_transform::levels(decoder, bytes)?;
            Ok(format!("{name} {}\n", levels.join(" ")))
        }),
        ("scenes", |decoder, name, bytes| {
            Ok(digest_scene::lines(name, &digest_scene::parts(decoder, bytes)?))
        }),
        ("sequences", |decoder, name, bytes| {
            digest_sequence::lines(decoder, name, bytes, false)
        }),
    ];
    for (name, lines) in suites {
        let folder = suite().join(name);
        let text = std::fs::read_to_string(folder.join("suite.txt"))?;
        let names = text.lines().filter_map(|line| line.split(' ').next());
        let names: Vec<&str> = names.filter(|name| !name.contains('/')).collect();
        let [_, learned @ ..] = heads::drawn(&suite(), Isa::detect());
        for (file, decoder) in learned {
            let mut text = String::new();
            for name in &names {
                let bytes = std::fs::read(folder.join(format!("{name}.b2p")))?;
                text += &lines(&decoder, name, &bytes).map_err(|error| format!("{name}: {error}"))?;
            }
            std::fs::write(folder.join(file), text)?;
        }
        println!("{name} with learned heads: {} streams", names.len());
    }
    Ok(())
}

/// Writes a suite in place of the one in a folder.
fn replace(folder: &Path, streams: &[(&str, Vec<u8>)], text: &str) -> Result {
    if folder.exists() {
        std::fs::remove_dir_all(folder)?;
    }
    std::fs::create_dir_all(folder)?;
    for (name, bytes) in streams {
        std::fs::write(folder.join(format!("{name}.b2p")), bytes)?;
    }
    std::fs::write(folder.join("suite.txt"), text)?;
    Ok(())
}

/// Writes the list of damaged streams.
fn damage() -> Result {
    let text = damage::list(&suite())?;
    std::fs::write(suite().join("damage.txt"), &text)?;
    println!("damage: {} streams, {} bytes", text.lines().count(), text.len());
    Ok(())
}

/// Makes the sample scene's cloud, and codes it as the streams inside the program.
fn sample() -> Result {
    let folder = root().join("target/xtask");
    std::fs::create_dir_all(&folder)?;
    let cloud = path(&folder.join("scene.ply"))?;
    let run = ["run", "--release", "--locked"];
    cargo(&[&run[..], &["--package", "b2p-lab", "--", "scene", "-o", &cloud]].concat())?;
    // The scene is embedded in the program: coarser steps than the default's.
    let kinds = [
        ("scene", "transform", &["--step", "35"][..]),
        ("sample", "learned", &[]),
    ];
    for (stream, colours, more) in kinds {
        let stream = path(&root().join(format!("models/{stream}.b2p")))?;
        let encode = [
            "--bin",
            "b2p",
            "--",
            "encode",
            "--force",
            &cloud,
            "-o",
            &stream,
            "--colours",
            colours,
        ];
        cargo(&[&run[..], &encode, more].concat())?;
    }
    Ok(())
}

fn path(path: &Path) -> Result<String> {
    let text = path
        .to_str()
        .ok_or_else(|| format!("{} is not UTF-8", path.display()))?;
    Ok(text.to_owned())
}

/// Runs cargo in the repository.
fn cargo(arguments: &[&str]) -> Result {
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let status = Command::new(cargo).args(arguments).current_dir(root()).status()?;
    match status.success() {
        true => Ok(()),
        false => Err(format!("cargo {}: {status}", arguments.join(" ")).into()),
    }
}
