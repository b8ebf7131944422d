//! Plans: each unit of work is a command line that does its part and can be repeated.

use std::path::Path;
use std::process::Command;

use serde_json::Value;
use tempfile::TempDir;

use super::common::{Ball, names_in};
use super::{fails, succeeds};

const JOB: &str = r#"
inputs = ["clouds"]
to = "out"
encode = "--step 30"
render = "--size 20x10 --heads surfels --background '#102030'"
views = 3
contact-sheet = true
group = 2
"#;

/// A folder with three clouds and a job.
fn job() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("a b")).unwrap();
    for (name, radius) in [("x", 24.0), ("y 2", 27.0), ("z", 30.0)] {
        let cloud = Ball::new(7, radius).to_ply();
        std::fs::create_dir_all(folder.path().join("clouds")).unwrap();
        std::fs::write(folder.path().join("clouds").join(format!("{name}.ply")), cloud).unwrap();
    }
    let program = format!("program = {:?}\n", env!("CARGO_BIN_EXE_b2p"));
    std::fs::write(folder.path().join("job.toml"), JOB.to_owned() + &program).unwrap();
    folder
}

fn text(at: &Path, name: &str) -> String {
    std::fs::read_to_string(at.join(name)).unwrap()
}

/// Runs the command lines of a step in a shell.
fn run(at: &Path, commands: &str) {
    let done = Command::new("sh").arg("-e").arg(at.join(commands)).output().unwrap();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
}

#[test]
fn the_command_lines_of_a_plan_do_the_whole_job() {
    let folder = job();
    let at = folder.path();
    succeeds(at, &["plan", "job.toml", "--engine", "ray", "-o", "a b/plan"]);
    for step in ["encode", "render", "sheet"] {
        run(at, &format!("a b/plan/{step}.txt"));
    }
    assert_eq!(text(at, "a b/plan/encode.txt").lines().count(), 2);
    assert_eq!(text(at, "a b/plan/render.txt").lines().count(), 6);
    let files = |folder: &str| {
        let mut names = names_in(&at.join("out").join(folder));
        names.retain(|name| name != ".b2p");
        names.len()
    };
    assert_eq!([files("streams"), files("pictures"), files("sheets")], [3, 9, 3]);
    // The same as by hand.
    succeeds(at, &["encode", "clouds/y 2.ply", "y.b2p", "--step", "30"]);
    let draw = [
        "--size",
        "20x10",
        "--heads",
        "surfels",
        "--background",
        "#102030",
        "--orbit",
        "120,20",
    ];
    succeeds(at, &[&["render", "y.b2p", "y.png"][..], &draw].concat());
    let bytes = |name: &str| std::fs::read(at.join(name)).unwrap();
    assert!(bytes("y.b2p") == bytes("out/streams/y 2.b2p"));
    assert!(bytes("y.png") == bytes("out/pictures/y 2-1.png"));
}

#[test]
fn a_template_lists_groups_and_views_of_each_step() {
    let folder = job();
    let at = folder.path();
    succeeds(
        at,
        &["plan", "job.toml", "--engine", "openjd", "-o", "plan", "--views", "2"],
    );
    let template: Value = serde_json::from_str(&text(at, "plan/job.template.json")).unwrap();
    let names = template["steps"]
        .as_array()
        .unwrap()
        .iter()
        .map(|step| step["name"].as_str().unwrap());
    assert_eq!(names.collect::<Vec<_>>(), ["Encode", "Render", "Sheet"]);
    let render = &template["steps"][1];
    assert_eq!(render["dependencies"][0]["dependsOn"], "Encode");
    let space = &render["parameterSpace"];
    assert_eq!(space["combination"], "Group * (View, Orbit)");
    assert_eq!(space["taskParameterDefinitions"][0]["range"], "0-1");
    assert_eq!(space["taskParameterDefinitions"][2]["range"][1], "180,20");
}

#[test]
fn batch_scripts_are_scripts() {
    let folder = job();
    let at = folder.path();
    succeeds(at, &["plan", "job.toml", "--engine", "slurm", "-o", "plan"]);
    for script in ["encode.sbatch", "render.sbatch", "submit.sh"] {
        let checked = Command::new("bash")
            .arg("-n")
            .arg(at.join("plan").join(script))
            .status()
            .unwrap();
        assert!(checked.success(), "{script}");
    }
    let script = text(at, "plan/render.sbatch");
    assert!(
        script.contains("#SBATCH --array=0-5\n") && script.contains("SLURM_ARRAY_TASK_ID / 3"),
        "{script}"
    );
}

#[test]
fn jobs_that_cannot_be_planned_say_why() {
    let folder = job();
    let at = folder.path();
    let plan = |more: &[&'static str]| [&["plan", "--engine", "slurm", "-o", "plan"][..], more].concat();
    fails(at, &plan(&[]), &["no folder for the results"]);
    fails(at, &plan(&["--to", "out"]), &["no inputs"]);
    fails(
        at,
        &plan(&["job.toml", "--group", "1", "--views", "400"]),
        &["render has 1200 units", "raise --group"],
    );
    fails(
        at,
        &plan(&["job.toml", "--render", "'open"]),
        &["render: \"'open\" has an open quotation mark"],
    );
    std::fs::write(at.join("bad.toml"), "view = 3\n").unwrap();
    fails(at, &plan(&["bad.toml"]), &["bad.toml", "unknown field `view`"]);
}
