//! What a viewer shows, and how keys and the mouse change it. There is no window in here.

use std::path::{Path, PathBuf};

use b2p::HeadSet;
use b2p::renderer::Background;

use super::clip::Clip;
use super::keys::Action;
use super::orbit::OrbitCamera;
use super::pace::Pace;
use super::source::{Arrived, Choices, Scene, Wish};

/// Backgrounds to choose from, beside that of the arguments.
const BACKGROUNDS: [Background; 4] = [
    Background::WHITE,
    Background::Colour([0.5; 3]),
    Background::BLACK,
    Background::Transparent,
];

/// What is to be done after a change.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Effect {
    Nothing,
    /// The picture stays, what is written over it does not.
    Overlay,
    /// The camera moves: a picture as good as there is time for.
    Move,
    /// A picture in full.
    Draw,
    /// Ask the source for [`State::wanted`].
    Load,
    Screenshot,
    Close,
}

/// The files that can be shown, what is shown of them, and how.
pub struct State {
    pub camera: OrbitCamera,
    pub pace: Pace,
    pub clip: Clip,
    /// Width and height of the picture.
    pub size: [u32; 2],
    pub scene: Option<Scene>,
    pub times: bool,
    pub help: bool,
    /// What the user should know: an error, or where a screenshot is.
    pub message: Option<String>,
    /// Whether something is still to arrive.
    pub busy: bool,
    files: Vec<PathBuf>,
    file: usize,
    number: u64,
    level: Option<u8>,
    heads: Option<HeadSet>,
    choices: Choices,
    backgrounds: Vec<Background>,
}

impl State {
    /// Shows the first of `files`, of which there is at least one.
    pub fn new(files: Vec<PathBuf>, camera: OrbitCamera, background: Background, size: [u32; 2]) -> Self {
        let others = BACKGROUNDS.into_iter().filter(|other| *other != background);
        State {
            camera,
            pace: Pace::default(),
            clip: Clip::default(),
            size,
            scene: None,
            times: false,
            help: false,
            message: None,
            busy: true,
            files,
            file: 0,
            number: 0,
            level: None,
            heads: None,
            choices: Choices::default(),
            backgrounds: [background].into_iter().chain(others).collect(),
        }
    }

    /// The same with this level and these heads of streams.
    pub fn with_detail(mut self, level: Option<u8>, heads: Option<HeadSet>) -> Self {
        (self.level, self.heads) = (level, heads);
        self
    }

    /// What the source is to make.
    pub fn wanted(&self) -> Wish {
        Wish {
            number: self.number,
            path: self.path().to_owned(),
            level: self.level,
            heads: self.heads,
        }
    }

    /// The file that is shown.
    pub fn path(&self) -> &Path {
        self.files.get(self.file).map_or(Path::new(""), PathBuf::as_path)
    }

    /// The file that is shown, which of how many it is, and whether more of it is to come, for a title.
    pub fn title(&self) -> String {
        let name = self.path().file_name().unwrap_or(self.path().as_os_str());
        let name = name.to_string_lossy();
        let place = match self.files.len() {
            1 => String::new(),
            count => format!(" ({} of {count})", self.file + 1),
        };
        let decoding = if self.busy { ", decoding" } else { "" };
        format!("{name}{place}{decoding} – b2p")
    }

    /// Whether there is another file to go to.
    pub fn has_others(&self) -> bool {
        self.files.len() > 1
    }

    /// What is seen where nothing is.
    pub fn background(&self) -> Background {
        self.backgrounds[0]
    }

    /// Does what a key asks for.
    pub fn act(&mut self, action: Action) -> Effect {
        self.message = None;
        let size = self.size;
        match action {
            Action::Turn(azimuth, elevation) => self.camera.turn(azimuth, elevation),
            Action::Pan(x, y) => {
                let height = f64::from(size[1]);
                self.camera.pan([x * height, y * height], size);
            }
            Action::Zoom(factor) => self.camera.zoom(factor),
            Action::Reset => {
                self.camera.reset(size);
                return Effect::Draw;
            }
            Action::Finer => return self.go_to_level(1),
            Action::Coarser => return self.go_to_level(-1),
            Action::Heads => return self.next_heads(),
            Action::Background => {
                self.backgrounds.rotate_left(1);
                return Effect::Draw;
            }
            Action::Clip => {
                let extent = self.scene.as_ref().map(|scene| &scene.extent);
                self.clip.toggle(extent);
                return Effect::Draw;
            }
            Action::ClipAxis(axis) => return self.clip.choose(axis),
            Action::ClipFace { high, by } => return self.clip.shift(high, by),
            Action::Times => {
                self.times = !self.times;
                return Effect::Overlay;
            }
            Action::Help => {
                self.help = !self.help;
                return Effect::Overlay;
            }
            Action::Screenshot => return Effect::Screenshot,
            Action::NextFile => return self.go_to_file(1),
            Action::PreviousFile => return self.go_to_file(-1),
            Action::Close => return Effect::Close,
        }
        Effect::Move
    }

    /// Shows other files, from the one at `first` on.
    pub fn open(&mut self, files: Vec<PathBuf>, first: usize) -> Effect {
        if first >= files.len() {
            return Effect::Nothing;
        }
        (self.files, self.file) = (files, first);
        self.another()
    }

    /// Takes what the source tells, unless it is for an earlier wish.
    pub fn take(&mut self, number: u64, arrived: Arrived) -> Effect {
        if number != self.number {
            return Effect::Nothing;
        }
        match arrived {
            Arrived::Choices(choices) => {
                self.choices = choices;
                Effect::Overlay
            }
            Arrived::Scene(scene) => {
                let frame = scene.gaussians.frame;
                self.camera.look_at(scene.extent.clone(), frame, scene.up, self.size);
                self.scene = Some(*scene);
                Effect::Draw
            }
            Arrived::Done => {
                self.busy = false;
                Effect::Overlay
            }
            Arrived::Failed(message) => {
                self.busy = false;
                self.message = Some(message);
                Effect::Overlay
            }
        }
    }

    /// The picture has another size from now on.
    pub fn resize(&mut self, size: [u32; 2]) -> Effect {
        self.size = size;
        self.camera.resize(size);
        Effect::Draw
    }

    /// What is shown, in a line.
    pub fn line(&self) -> String {
        let name = self.path().file_name().unwrap_or(self.path().as_os_str());
        let mut line = name.to_string_lossy().into_owned();
        if let Some(scene) = &self.scene {
            let count = crate::table::counted(scene.gaussians.len() as u64, "Gaussian");
            if let Some((level, heads)) = scene.made {
                line += &format!(", level {level}, {heads}");
            }
            line += &format!(", {count}");
        }
        match self.busy {
            true => line + ", decoding",
            false => line,
        }
    }

    /// A level further on, of those that there are.
    fn go_to_level(&mut self, by: i32) -> Effect {
        let levels = &self.choices.levels;
        let (Some(first), Some(last)) = (levels.first(), levels.last()) else {
            return self.say("there are no levels in this file");
        };
        let level = i32::from(self.level.unwrap_or(*last)) + by;
        let level = level.clamp(i32::from(*first), i32::from(*last)) as u8;
        if self.level.unwrap_or(*last) == level {
            return self.say(&format!("levels go from {first} to {last}"));
        }
        self.level = (level != *last).then_some(level);
        self.again()
    }

    fn next_heads(&mut self) -> Effect {
        let all = &self.choices.heads;
        if all.len() < 2 {
            return self.say("there are no other heads for this file");
        }
        let made = self.scene.as_ref().and_then(|scene| scene.made);
        let now = self.heads.or(made.map(|(_, heads)| heads));
        let at = all.iter().position(|heads| Some(*heads) == now).unwrap_or(0);
        self.heads = Some(all[(at + 1) % all.len()]);
        self.again()
    }

    fn go_to_file(&mut self, by: i32) -> Effect {
        let count = self.files.len() as i32;
        if count < 2 {
            return self.say("there is no other file");
        }
        self.file = (self.file as i32 + by).rem_euclid(count) as usize;
        self.another()
    }

    /// The file at hand, otherwise.
    fn again(&mut self) -> Effect {
        self.number += 1;
        self.busy = true;
        Effect::Load
    }

    /// Another file, from the start.
    fn another(&mut self) -> Effect {
        self.camera.forget();
        self.clip = Clip::default();
        self.scene = None;
        self.choices = Choices::default();
        // A level of one stream may not be there in another.
        self.level = None;
        self.message = None;
        self.again()
    }

    fn say(&mut self, what: &str) -> Effect {
        self.message = Some(what.to_owned());
        Effect::Overlay
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use b2p::{Extent, Frame, Gaussians};

    use super::*;
    use crate::args::Orbit;
    use crate::view::keys::{Key, action};
    use crate::view::orbit::Start;

    fn state(files: &[&str]) -> State {
        let orbit = Orbit {
            azimuth: 20.0,
            elevation: 10.0,
            distance: None,
        };
        let camera = OrbitCamera::new(Start {
            orbit,
            fov: 45.0,
            look_at: None,
        });
        State::new(
            files.iter().map(PathBuf::from).collect(),
            camera,
            Background::WHITE,
            [200, 100],
        )
    }

    fn scene(radius: f64, level: u8) -> Arrived {
        Arrived::Scene(Box::new(Scene {
            gaussians: Arc::new(Gaussians {
                frame: Frame::default(),
                ..Gaussians::default()
            }),
            extent: Extent::of([([0.0; 3], radius)].into_iter()),
            up: None,
            made: Some((level, HeadSet::Best)),
            steps: Vec::new(),
        }))
    }

    fn choices() -> Arrived {
        Arrived::Choices(Choices {
            levels: vec![7, 8, 9],
            heads: HeadSet::ALL.to_vec(),
        })
    }

    fn press(state: &mut State, key: char) -> Effect {
        state.act(action(Key::Char(key), false).unwrap())
    }

    #[test]
    fn levels_appear_one_after_the_other_and_the_camera_stays() {
        let mut state = state(&["a.b2p"]);
        assert_eq!(state.take(0, choices()), Effect::Overlay);
        assert_eq!(state.take(0, scene(0.5, 7)), Effect::Draw);
        let before = state.camera.camera([200, 100]).unwrap();
        assert_eq!(state.take(0, scene(0.3, 8)), Effect::Draw);
        assert_eq!(state.take(0, Arrived::Done), Effect::Overlay);
        assert_eq!(state.camera.camera([200, 100]).unwrap(), before);
        assert!(
            !state.busy && state.line().contains("level 8, best"),
            "{}",
            state.line()
        );
    }

    #[test]
    fn keys_go_from_level_to_level_within_those_that_there_are() {
        let mut state = state(&["a.b2p"]);
        assert_eq!(press(&mut state, '['), Effect::Overlay);
        state.take(0, choices());
        assert_eq!(press(&mut state, ']'), Effect::Overlay);
        assert_eq!(state.message.as_deref(), Some("levels go from 7 to 9"));
        assert_eq!(press(&mut state, '['), Effect::Load);
        assert_eq!(state.wanted().level, Some(8));
        press(&mut state, '[');
        assert_eq!(press(&mut state, '['), Effect::Overlay);
        assert_eq!(state.wanted().level, Some(7));
        press(&mut state, ']');
        press(&mut state, ']');
        assert_eq!(state.wanted().level, None);
    }

    #[test]
    fn heads_go_around() {
        let mut state = state(&["a.b2p"]);
        assert_eq!(press(&mut state, 'h'), Effect::Overlay);
        state.take(0, choices());
        state.take(0, scene(0.5, 9));
        let mut seen = Vec::new();
        for _ in 0..3 {
            assert_eq!(press(&mut state, 'h'), Effect::Load);
            seen.push(state.wanted().heads.unwrap());
        }
        assert_eq!(seen, [HeadSet::Quick, HeadSet::Surfels, HeadSet::Best]);
    }

    #[test]
    fn what_arrives_late_for_an_earlier_wish_is_not_shown() {
        let mut state = state(&["a.b2p"]);
        state.take(0, choices());
        press(&mut state, '[');
        assert_eq!(state.take(0, scene(0.5, 9)), Effect::Nothing);
        assert!(state.scene.is_none());
        assert_eq!(state.take(1, scene(0.5, 8)), Effect::Draw);
    }

    #[test]
    fn another_file_is_shown_from_the_start_with_a_camera_of_its_own() {
        let mut state = state(&["a.b2p", "b.ply", "c.spz"]);
        assert_eq!(state.title(), "a.b2p (1 of 3), decoding – b2p");
        state.take(0, choices());
        state.take(0, scene(0.5, 9));
        let first = state.camera.camera([200, 100]).unwrap();
        press(&mut state, '[');
        press(&mut state, '+');
        assert_eq!(press(&mut state, 'p'), Effect::Load);
        assert_eq!(
            state.wanted(),
            Wish {
                number: 2,
                path: "c.spz".into(),
                level: None,
                heads: None
            }
        );
        assert!(state.scene.is_none());
        state.take(2, scene(0.1, 9));
        assert_ne!(state.camera.camera([200, 100]).unwrap(), first);
        press(&mut state, 'n');
        state.take(3, scene(0.5, 9));
        assert_eq!(state.camera.camera([200, 100]).unwrap(), first);
    }

    #[test]
    fn a_file_that_is_dropped_takes_the_place_of_the_others() {
        let mut state = state(&["a.b2p", "b.ply"]);
        assert_eq!(state.open(vec!["d.b2p".into()], 0), Effect::Load);
        assert_eq!(state.wanted().path, Path::new("d.b2p"));
        assert!(!state.has_others());
        assert_eq!(state.open(Vec::new(), 0), Effect::Nothing);
    }

    #[test]
    fn backgrounds_go_around_and_begin_with_the_one_that_was_asked_for() {
        let mut state = state(&["a.b2p"]);
        let mut seen = Vec::new();
        for _ in 0..5 {
            seen.push(state.background());
            assert_eq!(press(&mut state, 'b'), Effect::Draw);
        }
        assert_eq!(seen[0], Background::WHITE);
        assert_eq!(seen[4], seen[0]);
        assert!((1..4).all(|i| seen[i] != seen[i - 1]));
    }

    #[test]
    fn a_failure_is_said_and_what_was_there_stays() {
        let mut state = state(&["a.b2p"]);
        state.take(0, scene(0.5, 8));
        assert_eq!(state.take(0, Arrived::Failed("damaged".into())), Effect::Overlay);
        assert_eq!(state.message.as_deref(), Some("damaged"));
        assert!(state.scene.is_some() && !state.busy);
        assert_eq!(press(&mut state, 't'), Effect::Overlay);
        assert_eq!(state.message, None);
    }

    #[test]
    fn keys_ask_for_what_they_say() {
        let mut state = state(&["a.b2p"]);
        for (key, effect) in [
            ('s', Effect::Screenshot),
            ('q', Effect::Close),
            ('?', Effect::Overlay),
            ('+', Effect::Move),
            ('r', Effect::Draw),
            ('c', Effect::Draw),
            ('x', Effect::Overlay),
            ('>', Effect::Draw),
            ('c', Effect::Draw),
            ('>', Effect::Nothing),
        ] {
            assert_eq!(press(&mut state, key), effect, "{key}");
        }
        assert_eq!(state.resize([50, 60]), Effect::Draw);
        assert_eq!(state.size, [50, 60]);
    }
}
