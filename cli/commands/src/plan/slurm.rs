//! Array jobs of Slurm.

use super::super::{Failure, Result};
use super::steps::{Step, quoted};
use super::{Texts, Work};

/// Slurm's default limit on the number of tasks in an array, MaxArraySize.
const MOST_TASKS: usize = 1000;

/// Adds a batch script for each step, and one that submits them; the result says how to run it.
pub fn files(work: &Work, files: &mut Texts) -> Result<String> {
    let mut submit = "#!/bin/sh\n# Submits the steps, each after the one that it needs.\nset -eu\n".to_owned();
    for step in &work.steps {
        if step.units() > MOST_TASKS {
            let (name, units) = (step.name, step.units());
            return Err(Failure(format!(
                "{name} has {units} units of work, and an array of Slurm {MOST_TASKS}: raise --group"
            )));
        }
        files.push((format!("{}.sbatch", step.name), script(step, work)));
        let after = step
            .after
            .map_or_else(String::new, |after| format!(" --dependency=afterany:\"${after}\""));
        let path = work.folder.join(format!("{}.sbatch", step.name));
        let path = quoted(&path.display().to_string());
        submit += &format!(
            "{0}=$(sbatch --parsable{after} {path})\necho \"{0}: job ${0}\"\n",
            step.name
        );
    }
    files.push(("submit.sh".into(), submit));
    files.push(("logs/README".into(), "What the tasks say.\n".into()));
    Ok(format!(
        "sh {}",
        quoted(&work.folder.join("submit.sh").display().to_string())
    ))
}

fn script(step: &Step, work: &Work) -> String {
    let (name, cores) = (step.name, work.cores);
    let last = step.units() - 1;
    let logs = work.folder.join("logs").display().to_string();
    let orbits: Vec<String> = step.orbits.iter().map(|orbit| quoted(orbit)).collect();
    let arguments = step.with("\u{1}", "\u{2}", "\u{3}");
    let variables = [("\u{1}", "group"), ("\u{2}", "view"), ("\u{3}", "orbit")];
    let words = arguments.iter().map(|word| {
        let mut word = quoted(word);
        for (mark, name) in variables {
            // Out of single quotes, if it is within them.
            let inside = if word.starts_with('\'') {
                format!("'\"${name}\"'")
            } else {
                format!("\"${name}\"")
            };
            word = word.replace(mark, &inside);
        }
        word
    });
    let words: Vec<String> = words.collect();
    format!(
        "#!/bin/bash\n\
         #SBATCH --job-name=b2p-{name}\n\
         #SBATCH --array=0-{last}\n\
         #SBATCH --ntasks=1\n\
         #SBATCH --cpus-per-task={cores}\n\
         #SBATCH --requeue\n\
         #SBATCH --output={logs}/{name}-%a.txt\n\
         #SBATCH --open-mode=append\n\
         orbits=({orbits})\n\
         group=$((SLURM_ARRAY_TASK_ID / {views})) view=$((SLURM_ARRAY_TASK_ID % {views}))\n\
         orbit=${{orbits[view]:-}}\n\
         status=0\n\
         {program} {words} || status=$?\n\
         # Done again up to twice: what was done is skipped.\n\
         if [ $status -ne 0 ] && [ \"${{SLURM_RESTART_COUNT:-0}}\" -lt 2 ]; then\n\
         \x20   scontrol requeue \"$SLURM_JOB_ID\"\n\
         fi\n\
         exit $status\n",
        orbits = orbits.join(" "),
        views = step.views(),
        program = quoted(&work.program),
        words = words.join(" "),
    )
}
