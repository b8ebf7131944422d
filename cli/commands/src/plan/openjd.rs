//! A job template of the [Open Job Description](https://github.com/OpenJobDescription/openjd-specifications), version
//! 2023-09.

use serde_json::{Value, json};

use super::super::{Failure, Result};
use super::steps::Step;
use super::{Texts, Work};

/// Values of a parameter that a template may list.
const MOST_VALUES: usize = 1024;

/// Adds the template; the result says how to run it.
pub fn files(work: &Work, files: &mut Texts) -> Result<String> {
    let steps = work
        .steps
        .iter()
        .map(|step| step_of(step, work))
        .collect::<Result<Vec<_>>>()?;
    let template = json!({
        "specificationVersion": "jobtemplate-2023-09",
        "name": "b2p",
        "parameterDefinitions": [{"name": "Program", "type": "STRING", "default": work.program}],
        "steps": steps,
    });
    files.push(("job.template.json".into(), format!("{template:#}\n")));
    let path = work.folder.join("job.template.json");
    Ok(format!("openjd run {}", path.display()))
}

fn step_of(step: &Step, work: &Work) -> Result<Value> {
    let name = |name: &str| name[..1].to_uppercase() + &name[1..];
    let mut parameters = vec![json!({"name": "Group", "type": "INT", "range": range(step.groups)})];
    let mut combination = "Group".to_owned();
    if !step.orbits.is_empty() {
        if step.orbits.len() > MOST_VALUES {
            let views = step.orbits.len();
            return Err(Failure(format!(
                "{views} views: an OpenJD template has at most {MOST_VALUES}"
            )));
        }
        parameters.push(json!({"name": "View", "type": "INT", "range": range(step.orbits.len())}));
        parameters.push(json!({"name": "Orbit", "type": "STRING", "range": step.orbits}));
        combination += " * (View, Orbit)";
    }
    let value = |name: &str| format!("{{{{Task.Param.{name}}}}}");
    let mut described = json!({
        "name": name(step.name),
        "parameterSpace": {"taskParameterDefinitions": parameters, "combination": combination},
        "hostRequirements": {"amounts": [{"name": "amount.worker.vcpu", "min": work.cores}]},
        "script": {"actions": {"onRun": {
            "command": "{{Param.Program}}",
            "args": step.with(&value("Group"), &value("View"), &value("Orbit")),
        }}},
    });
    if let Some(after) = step.after {
        described["dependencies"] = json!([{"dependsOn": name(after)}]);
    }
    Ok(described)
}

fn range(count: usize) -> String {
    match count {
        1 => "0".into(),
        count => format!("0-{}", count - 1),
    }
}
