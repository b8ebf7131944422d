//! The conformance suite: small streams, and what each must decode to, bit for bit, on every machine.
//!
//! `tests/data/conformance/suite.txt` has a line for each stream: its name, its model, then for every level `level=`
//! and the SHA-256 of its geometry (Morton keys, u64), latents and features (i16) and, where the model has a head,
//! Gaussians (positions, scales, rotations, opacities, colours, f32), all little-endian. Here each line is tried with
//! every instruction set of the machine, one, two and seven threads, whole and in pieces. The bare decoder
//! (`--no-default-features`) is enough for that.
//!
//! The suites of version 3, of scenes and of sequences are beside it: see `transform`, `scene` and `sequence`. Each is
//! drawn as surfels (`suite.txt`), and with the learned heads of `heads.safetensors` (`best.txt`, `quick.txt`).
//!
//! After a change of the format or of the shipped model, `cargo xtask conformance` makes streams and digests again.

#[cfg(feature = "encoder")]
#[path = "../common/mod.rs"]
mod common;
mod damage;
mod digest;
mod digest_scene;
mod digest_sequence;
mod digest_transform;
mod heads;
#[cfg(feature = "encoder")]
mod make;
#[cfg(feature = "encoder")]
mod make_scene;
#[cfg(feature = "encoder")]
mod make_sequence;
#[cfg(feature = "encoder")]
mod make_transform;
mod models;
mod scene;
#[cfg(feature = "encoder")]
#[path = "../common/seal.rs"]
mod seal;
mod sequence;
mod transform;

use std::path::{Path, PathBuf};

use b2p::Isa;
use b2p::latents::LatentDecoder;
use b2p::latents::network::Model;
use b2p::layers::Precision;
use b2p::log::Log;
use digest::{Levels, in_pieces, whole};
use models::model;

/// The repository.
fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn folder() -> PathBuf {
    root().join("tests/data/conformance")
}

/// A line of the suite.
struct Line {
    name: String,
    model: String,
    levels: Vec<String>,
}

fn suite() -> Vec<Line> {
    let text = std::fs::read_to_string(folder().join("suite.txt")).expect("the suite is there");
    let line = |line: &str| {
        let mut words = line.split(' ').map(str::to_owned);
        Line {
            name: words.next().expect("a name"),
            model: words.next().expect("a model"),
            levels: words.collect(),
        }
    };
    text.lines().map(line).collect()
}

fn stream(name: &str) -> Vec<u8> {
    std::fs::read(folder().join(format!("{name}.b2p"))).expect("every line has a stream")
}

/// A number of threads, and where they wait.
type Pool = (usize, Option<rayon::ThreadPool>);

/// With what a file of digests is tried: on all pools if it is of surfels. Learned heads have tests of their own with
/// other numbers of threads.
fn pools_for<'a>(file: &str, pools: &'a [Pool]) -> &'a [Pool] {
    let middle = pools.len() / 2;
    match file {
        "suite.txt" => pools,
        _ => &pools[middle..=middle],
    }
}

/// One, two and seven threads, or as many as `B2P_THREADS` says; targets without threads have the calling one alone.
fn pools() -> Vec<Pool> {
    if cfg!(target_family = "wasm") {
        return vec![(1, None)];
    }
    let pool = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
        (threads, Some(pool.build().expect("threads start")))
    };
    match std::env::var("B2P_THREADS") {
        Ok(threads) => vec![pool(threads.parse().expect("B2P_THREADS is a number"))],
        Err(_) => [1, 2, 7].map(pool).into(),
    }
}

/// What this machine has, but for what `B2P_SKIP_ISAS` names: `tests/aarch64.sh` tries that on another processor.
fn instruction_sets() -> Vec<Isa> {
    let mut all = Isa::available();
    all.retain(|isa| !is_skipped(&isa.to_string()));
    assert!(!all.is_empty(), "B2P_SKIP_ISAS leaves nothing to try");
    all
}

fn is_skipped(name: &str) -> bool {
    let skipped = std::env::var("B2P_SKIP_ISAS").unwrap_or_default();
    skipped.split(',').any(|skipped| skipped == name)
}

#[test]
fn every_stream_decodes_to_its_digests_with_every_instruction_set_and_number_of_threads() {
    let suite = suite();
    assert!(suite.len() >= 60, "{} streams", suite.len());
    let pools = pools();
    let mut ran = Vec::new();
    let mut decodings = 0;
    for isa in instruction_sets() {
        let mut loaded: Option<(&str, Model)> = None;
        for line in &suite {
            if loaded.as_ref().is_none_or(|(name, _)| *name != line.model) {
                loaded = Some((&line.model, model(&line.model).with_isa(isa)));
            }
            let Some((_, model)) = &loaded else { continue };
            let bytes = stream(&line.name);
            for (threads, pool) in &pools {
                let of = format!("{} with {isa} and {threads} threads", line.name);
                let mut check = |how: &str, decode: fn(&Model, &[u8]) -> Levels| {
                    let found = match pool {
                        Some(pool) => pool.install(|| decode(model, &bytes)),
                        None => decode(model, &bytes),
                    };
                    assert_eq!(found, Ok(line.levels.clone()), "{of}, {how}");
                    decodings += 1;
                };
                check("whole", whole);
                check("in pieces", in_pieces);
            }
        }
        ran.push(isa.to_string());
    }
    println!("ran on {}", ran.join(", "));
    println!("{decodings} decodings of {} streams", suite.len());
    // Elsewhere it depends on the processor more.
    #[cfg(target_arch = "aarch64")]
    {
        let dotprod = std::arch::is_aarch64_feature_detected!("dotprod");
        let mut sets = vec!["scalar", "neon", "dotprod"];
        sets.truncate(2 + usize::from(dotprod));
        sets.retain(|set| !is_skipped(set));
        assert_eq!(ran, sets);
    }
}

/// What a release has written, every later one decodes (`docs/format.md`, clause 1.6.4): no version leaves the suites.
#[test]
fn the_suites_have_streams_of_every_version_of_the_format() {
    let format = std::fs::read_to_string(root().join("docs/format.md")).expect("the format is there");
    let named = format.lines().find_map(|line| line.split("major version: ").nth(1));
    let numbers = named.expect("clause 2.2.1 names the versions").split(' ');
    let versions: Vec<u16> = numbers.filter_map(|number| number.parse().ok()).collect();
    assert_eq!(versions, [2, 3]);
    for (version, suite) in versions.into_iter().zip(["suite.txt", "version-3/suite.txt"]) {
        let path = folder().join(suite);
        let text = std::fs::read_to_string(&path).expect("the suite is there");
        assert!(text.lines().count() >= 10, "{suite}");
        for line in text.lines() {
            let name = line.split(' ').next().expect("a name");
            let bytes = std::fs::read(path.with_file_name(format!("{name}.b2p"))).expect("every line has a stream");
            assert_eq!(b2p::container::version(&bytes), Some(version), "{name}");
        }
    }
}

/// Of the model that ships; what is off by more than a few thousandths would show.
#[test]
fn gaussians_in_half_are_near_those_in_f16_on_machines_that_sum_in_f16() {
    let bytes = stream("lite-encoded-sphere");
    let colours = |isa, precision| -> b2p::Result<Vec<f32>> {
        let model = model("lite").with_isa(isa).with_precision(precision)?;
        let gaussians = LatentDecoder::new(&model).decode(&bytes, None, &Log::default())?;
        Ok(gaussians.colour.as_flattened().to_vec())
    };
    let floats = colours(Isa::SCALAR, Precision::F16).expect("f16 is everywhere");
    let mut ran = Vec::new();
    for isa in Isa::available() {
        let half = match colours(isa, Precision::Half) {
            Ok(half) => half,
            Err(error) => {
                assert!(!isa.has_half(), "{isa}: {error}");
                continue;
            }
        };
        let pairs = floats.iter().zip(&half);
        let squares: f32 = pairs.map(|(a, b)| (a - b).powi(2)).sum();
        let off = (squares / floats.len() as f32).sqrt();
        println!("{isa}: colours have an error of {off:.1e}");
        assert!((1e-6..3e-3).contains(&off), "{isa}: {off}");
        ran.push(isa.to_string());
    }
    #[cfg(target_arch = "aarch64")]
    assert_eq!(!ran.is_empty(), std::arch::is_aarch64_feature_detected!("fp16"));
    println!(
        "half on {}",
        if ran.is_empty() { "none".into() } else { ran.join(", ") }
    );
}

#[cfg(feature = "encoder")]
#[test]
fn the_generator_makes_the_same_streams_again() {
    let suite = suite();
    let cases = make::cases();
    assert_eq!(cases.len(), suite.len());
    for (case, line) in cases.iter().zip(&suite) {
        assert_eq!((&case.name, case.model), (&line.name, &line.model[..]));
        if case.anywhere {
            assert!(case.bytes == stream(&case.name), "{} has changed", case.name);
        }
    }
}
