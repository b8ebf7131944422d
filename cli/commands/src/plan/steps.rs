//! The steps of a job, and the command line of each unit of work.

use std::path::Path;

/// What a group's number, a view's number and its camera stand for in command lines.
pub const GROUP: &str = "<group>";
pub const VIEW: &str = "<view>";
pub const ORBIT: &str = "<orbit>";

/// Units of work of one kind: one for each group of files and each view.
#[derive(Debug)]
pub struct Step {
    pub name: &'static str,
    /// The step that must have ended.
    pub after: Option<&'static str>,
    pub groups: usize,
    /// The value of `--orbit` of each view; empty if the step has none.
    pub orbits: Vec<String>,
    /// Arguments of the program, with [`GROUP`], [`VIEW`] and [`ORBIT`].
    pub arguments: Vec<String>,
}

impl Step {
    pub fn encode(options: Vec<String>, to: &Path, plan: &Path) -> Step {
        let mut arguments = base("encode", "clouds", plan);
        arguments.extend(output("--output", to, "streams"));
        arguments.extend(options);
        Step {
            name: "encode",
            after: None,
            groups: 0,
            orbits: Vec::new(),
            arguments,
        }
    }

    pub fn render(
        options: &[String],
        views: u32,
        elevation: f32,
        to: &Path,
        plan: &Path,
        after: Option<&'static str>,
    ) -> Step {
        let mut arguments = base("render", "drawn", plan);
        arguments.extend(output("--output", to, "pictures"));
        arguments.extend(["--name".into(), format!("{{stem}}-{VIEW}.png")]);
        arguments.push(format!("--orbit={ORBIT}"));
        arguments.extend_from_slice(options);
        let azimuth = |view: u32| 360.0 * f64::from(view) / f64::from(views);
        Step {
            name: "render",
            after,
            groups: 0,
            orbits: (0..views)
                .map(|view| format!("{},{elevation}", azimuth(view)))
                .collect(),
            arguments,
        }
    }

    pub fn sheet(options: &[String], views: u32, elevation: f32, to: &Path, plan: &Path) -> Step {
        let mut arguments = base("render", "drawn", plan);
        arguments.extend(output("--output", to, "sheets"));
        arguments.extend(["--contact-sheet", "--views"].map(String::from));
        arguments.extend([views.to_string(), format!("--orbit=0,{elevation}")]);
        arguments.extend_from_slice(options);
        Step {
            name: "sheet",
            after: Some("render"),
            groups: 0,
            orbits: Vec::new(),
            arguments,
        }
    }

    pub fn video(options: &[String], ending: &str, elevation: f32, to: &Path, plan: &Path) -> Step {
        let mut arguments = base("render", "drawn", plan);
        arguments.extend(output("--turntable", to, "videos"));
        arguments.extend([
            "--name".into(),
            format!("{{stem}}.{ending}"),
            format!("--orbit=0,{elevation}"),
        ]);
        arguments.extend_from_slice(options);
        Step {
            name: "video",
            after: Some("render"),
            groups: 0,
            orbits: Vec::new(),
            arguments,
        }
    }

    /// The same with so many threads in each unit.
    pub fn with_threads(mut self, threads: u16) -> Step {
        self.arguments.extend(["--threads".into(), threads.to_string()]);
        self
    }

    pub fn views(&self) -> usize {
        self.orbits.len().max(1)
    }

    pub fn units(&self) -> usize {
        self.groups * self.views()
    }

    /// The arguments with these in place of [`GROUP`], [`VIEW`] and [`ORBIT`].
    pub fn with(&self, group: &str, view: &str, orbit: &str) -> Vec<String> {
        let arguments = self.arguments.iter();
        let put = |argument: &String| argument.replace(GROUP, group).replace(VIEW, view).replace(ORBIT, orbit);
        arguments.map(put).collect()
    }

    /// All command lines, one a line.
    pub fn commands(&self, program: &str) -> String {
        let mut text = String::new();
        for group in 0..self.groups {
            for view in 0..self.views() {
                let orbit = self.orbits.get(view).map_or("", String::as_str);
                let words = [program.to_owned()].into_iter();
                let words = words.chain(self.with(&group.to_string(), &view.to_string(), orbit));
                let words: Vec<String> = words.map(|word| quoted(&word)).collect();
                text += &words.join(" ");
                text.push('\n');
            }
        }
        text
    }
}

/// What all commands begin with.
fn base(command: &str, list: &str, plan: &Path) -> Vec<String> {
    let list = plan.join("lists").join(format!("{list}-{GROUP}.txt"));
    let words = [command, "--resume", "--files-from"].map(String::from);
    words.into_iter().chain([list.display().to_string()]).collect()
}

fn output(option: &str, to: &Path, folder: &str) -> [String; 2] {
    [option.into(), format!("{}/", to.join(folder).display())]
}

/// A word as a shell reads it.
pub fn quoted(word: &str) -> String {
    shlex::try_quote(word).map_or_else(|_| format!("{word:?}"), std::borrow::Cow::into_owned)
}
