//! A program for Ray.

use serde_json::{Value, json};

use super::steps::quoted;
use super::{Texts, Work};

/// Adds the program; the result says how to run it.
pub fn files(work: &Work, files: &mut Texts) -> String {
    let steps = work.steps.iter().map(|step| {
        json!({
            "name": step.name,
            "after": step.after,
            "groups": step.groups,
            "orbits": step.orbits,
            "arguments": step.with("{group}", "{view}", "{orbit}"),
        })
    });
    let steps = format!(
        "{:#}\n",
        json!({"program": work.program, "cores": work.cores, "steps": Value::from_iter(steps)})
    );
    files.push(("job.json".into(), steps));
    files.push(("job.py".into(), include_str!("ray.py").into()));
    let path = work.folder.join("job.py");
    format!("python {}", quoted(&path.display().to_string()))
}
