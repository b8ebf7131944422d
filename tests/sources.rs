//! What the sources themselves promise: which stage may know which, what the exact zone may not use, where `unsafe` may stand.

use std::path::{Path, PathBuf};

/// The stages in the order in which data flows through them. What is not listed serves all stages, or drives them.
const STAGES: [&str; 10] = [
    "bitstream",
    "geometry",
    "colour",
    "entropy",
    "network",
    "cloud",
    "gaussians",
    "projection",
    "tiles",
    "pixels",
];

/// What drives the stages, and no stage may know.
const DRIVERS: [&str; 6] = ["decoder", "encoder", "embedded", "tradeoff", "cli", "log"];

/// Sources whose every result must be the same bits on every machine.
const EXACT: [&str; 28] = [
    "src/bitstream",
    "src/coding",
    "src/colour",
    "src/geometry",
    "src/entropy",
    "src/network/passes.rs",
    "src/network/children.rs",
    "src/network/container.rs",
    "src/network/exact.rs",
    "src/network/generate.rs",
    "src/network/layers.rs",
    "src/network/load.rs",
    "src/network/shape.rs",
    "src/network/stored.rs",
    "src/network/structure.rs",
    "src/decoder/decoding.rs",
    "src/gaussians/activations.rs",
    "src/gaussians/heads.rs",
    "kernels/src/exact.rs",
    "kernels/src/family.rs",
    "kernels/src/finish.rs",
    "kernels/src/norms.rs",
    "kernels/src/plan.rs",
    "kernels/src/taps.rs",
    "kernels/src/rows.rs",
    "kernels/src/tile.rs",
    "kernels/src/winograd.rs",
    "kernels/src/machine",
];

/// The encoder's choices and what only tests use: nothing that a decoder computes.
const NOT_EXACT: [&str; 3] = [
    "src/colour/encode.rs",
    "src/entropy/quantise.rs",
    "src/entropy/test_tables.rs",
];

/// What differs between machines, mathematical libraries, runs, or orders of summation.
const FORBIDDEN: [(&str, &str); 26] = [
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

#[test]
fn a_stage_knows_only_the_stages_before_it() {
    let mut faults = Vec::new();
    for (place, stage) in STAGES.iter().enumerate() {
        for file in files(&format!("src/{stage}")) {
            if is_test(&file) {
                continue;
            }
            for (number, line) in code(&file) {
                let later = STAGES[place + 1..].iter().chain(&DRIVERS);
                for other in later.filter(|other| line.contains(&format!("crate::{other}"))) {
                    faults.push(format!("{}:{number}: {stage} uses {other}", named(&file)));
                }
            }
        }
    }
    for file in files("kernels/src") {
        for (number, line) in code(&file) {
            if line.contains("b2p::") {
                faults.push(format!("{}:{number}: kernels use a stage", named(&file)));
            }
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

#[test]
fn every_public_function_that_can_fail_says_how() {
    let mut faults = Vec::new();
    let mut looked_at = 0;
    let library = ["src", "kernels/src", "capi/src"].map(files).concat();
    for file in library.iter().filter(|file| !is_test(file)) {
        // The program's own parts are no interface.
        if named(file).starts_with("src/cli") {
            continue;
        }
        let text = std::fs::read_to_string(file).expect("a readable source");
        let lines: Vec<&str> = text.lines().collect();
        let functions = code(file)
            .into_iter()
            .filter(|(_, line)| line.trim_start().starts_with("pub fn "));
        for (number, _) in functions {
            let rest = lines[number - 1..].join(" ");
            let signature = rest.split(['{', ';']).next().unwrap_or_default();
            let result = signature.rsplit_once("->").map_or("", |(_, result)| result);
            if !result.trim_start().starts_with("Result<") {
                continue;
            }
            looked_at += 1;
            let above = lines[..number - 1].iter().rev();
            let docs: Vec<&str> = above
                .map(|line| line.trim_start())
                .take_while(|line| line.starts_with("///") || line.starts_with("#["))
                .collect();
            // Upwards: what follows the heading comes first. It links to errors, or to a function that has the same.
            let heading = docs.iter().position(|line| *line == "/// # Errors");
            let says = heading.is_some_and(|end| docs[..end].iter().any(|l| l.contains("[`")));
            if !says {
                faults.push(format!("{}:{number}: {signature}", named(file)));
            }
        }
    }
    assert!(looked_at > 80, "only {looked_at} functions that can fail");
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

#[test]
fn unsafe_stands_only_in_the_kernels_and_at_the_c_border() {
    for library in ["src/lib.rs", "src/main.rs", "lab/src/lib.rs", "lab/src/bin/b2p-lab.rs"] {
        let text = std::fs::read_to_string(root().join(library)).expect("a readable source");
        let forbids = text.contains("#![forbid(unsafe_code)]");
        assert!(forbids, "{library} does not forbid unsafe code");
    }
    let keyword = |line: &str| {
        let mut words = line.split(|c: char| !c.is_alphanumeric() && c != '_');
        words.any(|word| word == "unsafe")
    };
    for file in ["src", "lab/src", "tests", "fuzz", "benches"]
        .iter()
        .flat_map(|b| files(b))
    {
        if named(&file) == "tests/sources.rs" {
            continue;
        }
        for (number, line) in code(&file) {
            assert!(!keyword(&line), "{}:{number} is unsafe", named(&file));
        }
    }
}

#[test]
fn no_file_has_grown_past_500_lines() {
    let folders = ["src", "kernels/src", "lab/src", "tests", "fuzz"];
    for file in folders.iter().flat_map(|below| files(below)) {
        let text = std::fs::read_to_string(&file).expect("a readable source");
        let lines = text.lines().count();
        assert!(lines <= 500, "{} has {lines} lines", named(&file));
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
