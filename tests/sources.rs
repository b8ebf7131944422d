//! What the sources themselves promise: which stage may import which, and what the exact zone may not use.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// The folders of `src/`, each with those that it may import beside the commons: an arrow only leads to a folder
/// further up.
const STAGES: [(&str, &[&str]); 15] = [
    ("coding", &[]),
    ("container", &[]),
    ("geometry", &["coding", "container"]),
    ("colour", &["coding", "container", "geometry"]),
    ("motion", &["coding", "container", "geometry", "colour"]),
    ("layers", &[]),
    ("cloud", &["geometry"]),
    ("gaussians", &["coding", "geometry", "layers", "cloud"]),
    ("renderer", &["gaussians"]),
    ("latents", &["coding", "container", "geometry", "layers", "gaussians"]),
    (
        "decoder",
        &[
            "container",
            "geometry",
            "colour",
            "motion",
            "layers",
            "cloud",
            "gaussians",
            "latents",
        ],
    ),
    (
        "encoder",
        &[
            "container",
            "geometry",
            "colour",
            "cloud",
            "gaussians",
            "renderer",
            "latents",
            "motion",
            "decoder",
        ],
    ),
    (
        "scene",
        &[
            "container",
            "geometry",
            "cloud",
            "gaussians",
            "renderer",
            "decoder",
            "encoder",
        ],
    ),
    (
        "sequence",
        &["container", "cloud", "gaussians", "motion", "decoder", "encoder"],
    ),
    ("metrics", &["renderer"]),
];

/// What every stage may use.
const COMMONS: [&str; 12] = [
    "input",
    "Error",
    "axes",
    "cancel",
    "error",
    "limits",
    "log",
    "memory",
    "output",
    "placement",
    "Isa",
    "testing",
];

/// Folders whose every result must be the same bits on every machine.
const EXACT: [&str; 11] = [
    "src/coding",
    "src/colour",
    "src/container",
    "src/geometry",
    "src/layers",
    "src/gaussians/learned",
    "src/gaussians/surfels",
    "src/latents/entropy",
    "src/latents/network",
    "kernels/src/exact",
    "kernels/src/sparse",
];

/// The encoder's choices and what only tests use: nothing that a decoder computes.
const NOT_EXACT: [&str; 6] = [
    "src/colour/encode.rs",
    "src/geometry/codec/optimise/mod.rs",
    "src/latents/entropy/quantise.rs",
    "src/latents/network/reference.rs",
    "src/latents/network/reference/neighbours.rs",
    "src/latents/network/untrained.rs",
];

/// The folders of `kernels/src`, each importing only from those before it. Without the feature `close`, that folder is
/// not compiled: nothing else can name it.
const KERNELS: [&str; 4] = ["simd", "sparse", "exact", "close"];

/// What differs between machines, mathematical libraries, runs, or orders of summation.
const FORBIDDEN: [(&str, &str); 27] = [
    (".exp(", "libraries differ in the last bit"),
    (".exp2(", "libraries differ in the last bit"),
    (".exp_m1(", "libraries differ in the last bit"),
    (".ln(", "libraries differ in the last bit"),
    (".ln_1p(", "libraries differ in the last bit"),
    (".log2(", "libraries differ in the last bit"),
    (".log10(", "libraries differ in the last bit"),
    (".powf(", "libraries differ in the last bit"),
    (".tanh(", "libraries differ in the last bit"),
    (".sin(", "libraries differ in the last bit"),
    (".cos(", "libraries differ in the last bit"),
    (".cbrt(", "libraries differ in the last bit"),
    (".mul_add(", "fused where the machine can, rounded twice elsewhere"),
    (".neg_mul_add(", "fused where the machine can, rounded twice elsewhere"),
    ("HashMap", "its order differs from run to run"),
    ("HashSet", "its order differs from run to run"),
    (".sum::<f32>", "a float sum depends on its order"),
    (".sum::<f64>", "a float sum depends on its order"),
    ("fold(0.0", "a float sum depends on its order"),
    (".reduce(", "its grouping depends on the threads"),
    ("dpwssds", "saturating sums depend on their order"),
    ("maddubs", "saturating sums depend on their order"),
    ("sqdmlal", "saturating sums depend on their order"),
    ("vqdmlal", "saturating sums depend on their order"),
    ("adds_epi", "saturating sums depend on their order"),
    ("relaxed_", "left to the implementation"),
    ("fast_math", "left to the compiler"),
];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// All Rust files below a folder, or the file itself.
fn files(below: &str) -> Vec<PathBuf> {
    let path = root().join(below);
    if path.is_file() {
        return vec![path];
    }
    let mut found = Vec::new();
    for entry in std::fs::read_dir(&path).unwrap_or_else(|e| panic!("{below}: {e}")) {
        let name = entry.expect("a readable entry").file_name();
        let name = name.to_str().expect("names are text");
        let child = format!("{below}/{name}");
        if root().join(&child).is_dir() && name != "target" {
            found.extend(files(&child));
        } else if name.ends_with(".rs") {
            found.push(root().join(child));
        }
    }
    found
}

/// The code of a file without comments and without what follows `#[cfg(test)]` at the end of it.
fn code(file: &Path) -> Vec<(usize, String)> {
    let text = std::fs::read_to_string(file).expect("a readable source");
    let lines = text
        .lines()
        .map(|line| line.split("//").next().unwrap_or("").to_owned());
    let lines = (1..).zip(lines).collect::<Vec<_>>();
    let tests = lines
        .windows(2)
        .position(|pair| pair[0].1.trim() == "#[cfg(test)]" && pair[1].1.trim_start().starts_with("mod tests {"));
    lines[..tests.unwrap_or(lines.len())].to_vec()
}

fn named(file: &Path) -> String {
    let inside = file.strip_prefix(root()).expect("files lie below the root");
    inside.display().to_string()
}

fn is_test(file: &Path) -> bool {
    let name = named(file);
    name.ends_with("tests.rs") || name.contains("/tests/")
}

#[test]
fn the_exact_zone_uses_nothing_that_differs_between_machines() {
    let mut faults = Vec::new();
    let mut looked_at = 0;
    for file in EXACT.iter().flat_map(|below| files(below)) {
        if is_test(&file) || NOT_EXACT.contains(&named(&file).as_str()) {
            continue;
        }
        for (number, line) in code(&file) {
            looked_at += 1;
            // A maximum is the same in any order.
            let maximum = line.contains(".max(") || line.contains("::max");
            for (forbidden, why) in FORBIDDEN {
                if line.contains(forbidden) && !(maximum && forbidden.starts_with("fold")) {
                    faults.push(format!("{}:{number}: {forbidden}: {why}", named(&file)));
                }
            }
        }
    }
    assert!(looked_at > 2000, "only {looked_at} lines: has the exact zone moved?");
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

/// The modules of the crate that a line of code names.
fn modules(line: &str) -> impl Iterator<Item = &str> {
    let uses = line
        .match_indices("crate::")
        .map(|(at, found)| &line[at + found.len()..]);
    uses.map(|rest| {
        rest.split(|c: char| !c.is_alphanumeric() && c != '_')
            .next()
            .unwrap_or(rest)
    })
}

#[test]
fn a_stage_imports_only_from_the_stages_before_it() {
    let mut faults = Vec::new();
    for (place, (stage, allowed)) in STAGES.iter().enumerate() {
        let before = &STAGES[..place];
        for import in *allowed {
            assert!(
                before.iter().any(|(name, _)| name == import),
                "{stage} comes before {import}"
            );
        }
        let mut unused: BTreeSet<&str> = allowed.iter().copied().collect();
        for file in files(&format!("src/{stage}")) {
            if is_test(&file) {
                continue;
            }
            for (number, line) in code(&file) {
                for module in modules(&line) {
                    unused.remove(module);
                    if module != *stage && !allowed.contains(&module) && !COMMONS.contains(&module) {
                        faults.push(format!("{}:{number}: {stage} uses {module}", named(&file)));
                    }
                }
            }
        }
        faults.extend(
            unused
                .iter()
                .map(|module| format!("{stage} may use {module}, but does not")),
        );
    }
    for common in COMMONS {
        let file = format!("src/{common}.rs");
        if !root().join(&file).is_file() {
            continue;
        }
        for (number, line) in code(&root().join(&file)) {
            for (stage, _) in STAGES.iter().filter(|(stage, _)| modules(&line).any(|m| m == *stage)) {
                if common != "testing" {
                    faults.push(format!("{file}:{number}: {common} uses {stage}"));
                }
            }
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

#[test]
fn a_folder_of_kernels_imports_only_from_the_folders_before_it() {
    let mut faults = Vec::new();
    for (place, folder) in KERNELS.iter().enumerate() {
        for file in files(&format!("kernels/src/{folder}")) {
            for (number, line) in code(&file) {
                for later in modules(&line).filter(|module| KERNELS[place + 1..].contains(module)) {
                    faults.push(format!("{}:{number}: {folder} uses {later}", named(&file)));
                }
            }
        }
    }
    for entry in std::fs::read_dir(root().join("kernels/src")).expect("kernels") {
        let entry = entry.expect("a readable entry");
        let name = entry.file_name().into_string().expect("names are text");
        if entry.path().is_dir() && !KERNELS.contains(&name.as_str()) {
            faults.push(format!("kernels/src/{name} has no place among the kernels"));
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

#[test]
fn every_folder_of_the_library_is_a_stage() {
    for entry in std::fs::read_dir(root().join("src")).expect("sources") {
        let entry = entry.expect("a readable entry");
        let name = entry.file_name().into_string().expect("names are text");
        let known = STAGES.iter().any(|(stage, _)| *stage == name) || name == "output";
        assert!(
            known || !entry.path().is_dir(),
            "src/{name} has no place among the stages"
        );
    }
}

#[test]
fn the_bare_decoder_stands_on_few_crates() {
    let tree = std::process::Command::new(env!("CARGO"))
        .current_dir(root())
        .args(["tree", "--locked", "--package", "b2p", "--no-default-features"])
        .args(["--edges", "normal", "--prefix", "none", "--format", "{p}"])
        .output()
        .expect("cargo lists the crates");
    assert!(tree.status.success(), "{tree:?}");
    let tree = String::from_utf8(tree.stdout).expect("names are text");
    let mut crates: Vec<&str> = tree
        .lines()
        .map(|line| line.split(" (").next().unwrap_or(line))
        .collect();
    crates.sort_unstable();
    crates.dedup();
    println!("{} crates: {}", crates.len(), crates.join(", "));
    assert!(crates.contains(&"b2p v0.1.0"));
    assert!(crates.len() <= 40, "{} crates", crates.len());
}
