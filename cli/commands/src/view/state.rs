//! What a viewer shows, and how keys and the mouse change it. There is no window in here.

use std::path::{Path, PathBuf};
use std::time::Instant;

use b2p::renderer::Background;
use b2p::sequence::play::clock::Clock;
use b2p::{Camera, HeadSet};

use super::clip::Clip;
use super::keys::{Action, ZOOM};
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
    /// Tell the source the clock.
    Play,
    Screenshot,
    Close,
}

/// The files that can be shown, what is shown of them, and how.
pub struct State {
    pub camera: OrbitCamera,
    pub pace: Pace,
    pub clip: Clip,
    /// Of a sequence.
    pub clock: Option<Clock>,
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
    /// The speed of sequences, and whether they are played in a loop.
    playing: (f64, bool),
    /// Whether a frame of the sequence has arrived, so that its clock runs.
    began: bool,
    /// The camera that the scene on show was made for, if it is too large to be shown as a whole.
    looked: Option<Camera>,
}

impl State {
    /// Shows the first of `files`, of which there is at least one.
    pub fn new(files: Vec<PathBuf>, camera: OrbitCamera, background: Background, size: [u32; 2]) -> Self {
        let others = BACKGROUNDS.into_iter().filter(|other| *other != background);
        State {
            camera,
            pace: Pace::default(),
            clip: Clip::default(),
            clock: None,
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
            playing: (1.0, true),
            began: false,
            looked: None,
        }
    }

    /// The same with this level and these heads of streams.
    pub fn with_detail(mut self, level: Option<u8>, heads: Option<HeadSet>) -> Self {
        (self.level, self.heads) = (level, heads);
        self
    }

    /// The same, which plays sequences this many times as fast as they were recorded, in a loop or once.
    pub fn with_playing(mut self, speed: f64, looped: bool) -> Self {
        self.playing = (speed, looped);
        self
    }

    /// What the source is to make.
    pub fn wanted(&self) -> Wish {
        Wish {
            number: self.number,
            path: self.path().to_owned(),
            level: self.level,
            heads: self.heads,
            camera: self.looked,
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
        let paused = self
            .paused()
            .map(|(frame, count)| format!(", paused at frame {frame} of {count}"));
        format!("{name}{place}{decoding}{} – b2p", paused.unwrap_or_default())
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
        if let Some(effect) = self.act_on_clock(action) {
            return effect;
        }
        let size = self.size;
        match action {
            Action::Turn(azimuth, elevation) => self.camera.turn(azimuth, elevation),
            Action::Pan(x, y) => {
                let height = f64::from(size[1]);
                self.camera.pan([x * height, y * height], size);
            }
            Action::Zoom(factor) => self.camera.zoom(factor),
            Action::Faster => self.camera.zoom(1.0 / ZOOM),
            Action::Slower => self.camera.zoom(ZOOM),
            Action::Pause | Action::Loop => return self.say("this is no sequence of frames"),
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

    /// Does what a key asks for of a sequence, if it does. Keys of the clipping box step while there is none.
    fn act_on_clock(&mut self, action: Action) -> Option<Effect> {
        self.clock.as_ref()?;
        Some(match action {
            Action::Faster => self.with_clock(|clock, now| clock.change_speed(true, now)),
            Action::Slower => self.with_clock(|clock, now| clock.change_speed(false, now)),
            Action::Pause => self.with_clock(Clock::toggle),
            Action::Loop => self.with_clock(Clock::toggle_loop),
            Action::ClipFace { high: false, by } if self.clip.corners().is_none() => {
                self.with_clock(|clock, now| clock.step(by.signum() as i64, now))
            }
            _ => return None,
        })
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
                let (speed, looped) = self.playing;
                let timeline = choices.timeline.clone();
                self.choices = choices;
                // With another level the clock goes on.
                if self.clock.is_none() {
                    self.clock = timeline.map(|timeline| Clock::new(timeline, speed, looped));
                }
                self.with_clock(|_, _| ())
            }
            Arrived::Scene(scene) => {
                let frame = scene.gaussians.frame;
                self.camera.look_at(scene.extent.clone(), frame, scene.up, self.size);
                let frame = scene.frame;
                self.scene = Some(*scene);
                match frame {
                    None => Effect::Draw,
                    Some(_) => self.begin().unwrap_or(match self.is_running() {
                        true => Effect::Move,
                        false => Effect::Draw,
                    }),
                }
            }
            Arrived::Skipped(message) => {
                self.message = Some(message);
                self.begin().unwrap_or(Effect::Overlay)
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
        line += &self.playing_line().unwrap_or_default();
        match self.busy {
            true => line + ", decoding",
            false => line,
        }
    }

    /// Goes to the frame at a share of the sequence's time.
    pub fn seek(&mut self, share: f64) -> Effect {
        self.message = None;
        self.with_clock(|clock, now| clock.seek(share, now))
    }

    /// Whether a sequence is played, and not paused.
    pub fn is_running(&self) -> bool {
        self.clock
            .as_ref()
            .is_some_and(|clock| clock.is_running(Instant::now()))
    }

    /// The frame at which a sequence is paused, and the number of its frames.
    fn paused(&self) -> Option<(u64, u64)> {
        let (clock, now) = (self.clock.as_ref()?, Instant::now());
        let is_paused = self.began && !clock.is_running(now);
        is_paused.then(|| (clock.frame(now), clock.timeline().count()))
    }

    /// The frame that is shown, of how many, and how a sequence is played.
    fn playing_line(&self) -> Option<String> {
        let clock = self.clock.as_ref()?;
        let frame = self.scene.as_ref()?.frame?;
        let speed = match clock.speed() {
            1.0 => String::new(),
            speed => format!(", speed {speed}"),
        };
        let how = match (self.paused(), clock.is_looped()) {
            (Some(_), _) => ", paused",
            (None, true) => "",
            (None, false) => ", once",
        };
        Some(format!(
            ", frame {} of {}{speed}{how}",
            frame.number,
            clock.timeline().count()
        ))
    }

    /// Changes the clock of a sequence.
    fn with_clock(&mut self, change: impl FnOnce(&mut Clock, Instant)) -> Effect {
        match &mut self.clock {
            Some(clock) => {
                change(clock, Instant::now());
                Effect::Play
            }
            None => Effect::Overlay,
        }
    }

    /// Lets the clock run when the first frame has arrived.
    fn begin(&mut self) -> Option<Effect> {
        if std::mem::replace(&mut self.began, true) {
            return None;
        }
        Some(self.with_clock(Clock::play))
    }

    /// Whether the source is to be asked for what the camera sees now, of a scene that is too large to be shown as a
    /// whole. To be called where the camera rests.
    pub fn look_again(&mut self) -> bool {
        let is_part = self.scene.as_ref().is_some_and(|scene| scene.is_part);
        let camera = self.camera.camera(self.size).ok();
        if !is_part || self.busy || camera.is_none() || camera == self.looked {
            return false;
        }
        self.looked = camera;
        self.again();
        true
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
        self.clock = None;
        self.began = false;
        self.looked = None;
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
mod tests;
