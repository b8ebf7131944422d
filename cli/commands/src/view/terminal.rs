//! `b2p view --terminal`: pictures as half blocks of 24-bit colours, or as sixels.

use std::fmt::Write as _;
use std::io::{IsTerminal, Write as _};
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel, sync_channel};

use console::{Key as TerminalKey, Term};

use super::keys::{self, HELP, Key, SEQUENCE_HELP};
use super::painter::{Destination, Order, Painted, Painter};
use super::player::Sources;
use super::source::{Arrived, Source};
use super::state::{Effect, State};
use super::{Kind, Viewer, screenshot_path};
use crate::manners::Said;
use crate::pipe::PIPE;
use crate::{Failure, Result};

/// Columns and rows where there is no terminal that could say.
const USUAL: (u16, u16) = (80, 24);
/// Pixels of a character that terminals with sixels have at least.
const CELL: [u32; 2] = [8, 16];

/// What the loop that shows pictures hears.
enum Told {
    Source(u64, Arrived),
    Painted(Painted),
    Key(TerminalKey),
    /// No more keys will come.
    NoKeys,
}

/// Shows one picture, or follows keys if both ends are a terminal.
pub fn run(viewer: Viewer, kind: Kind) -> Result<Said> {
    let terminal = Term::stdout();
    let is_followed = std::io::stdin().is_terminal() && terminal.is_term();
    let (columns, rows) = match viewer.size {
        Some(size) => size,
        None => {
            let (rows, columns) = terminal.size_checked().unwrap_or((USUAL.1, USUAL.0));
            // One line for words.
            (columns.into(), u32::from(rows.saturating_sub(1)).max(1))
        }
    };
    let size = match kind {
        Kind::Blocks => [columns, 2 * rows],
        Kind::Sixel => [columns.saturating_mul(CELL[0]), rows.saturating_mul(CELL[1])],
    };
    let (teller, told) = channel();
    let painter = {
        let teller = teller.clone();
        let limits = viewer.loading.limits.clone();
        Painter::start(viewer.isa, limits, move |painted| send(&teller, Told::Painted(painted)))?
    };
    let source = {
        let teller = std::sync::Mutex::new(teller.clone());
        let tell = move |number, arrived| {
            if let Ok(teller) = teller.lock() {
                send(&teller, Told::Source(number, arrived));
            }
        };
        Sources::start(viewer.loading, Arc::new(tell))?
    };
    let mut screen = Screen {
        state: viewer.state,
        source: Box::new(source),
        painter,
        kind,
        screenshots: viewer.screenshots,
        painting: false,
        again: false,
        is_followed,
        keys: None,
    };
    screen.state.resize(size);
    if is_followed {
        screen.keys = Some(follow(terminal, teller)?);
        print("\x1b[2J")?;
    }
    let ended = screen.run(&told);
    if is_followed {
        print("\x1b[0m\n")?;
    }
    ended.map(|()| Said::default())
}

/// Tells, if there is still somebody to listen.
fn send(teller: &Sender<Told>, told: Told) {
    let _ = teller.send(told);
}

/// Reads keys on a thread of its own, each when it is asked for: the terminal is as it was when the program ends.
fn follow(terminal: Term, teller: Sender<Told>) -> Result<std::sync::mpsc::SyncSender<()>> {
    let (next, asked) = sync_channel(1);
    let read = move || {
        while asked.recv().is_ok() {
            match terminal.read_key() {
                Ok(key) => send(&teller, Told::Key(key)),
                Err(_) => return send(&teller, Told::NoKeys),
            }
        }
    };
    let started = std::thread::Builder::new().spawn(read);
    started.map_err(|e| Failure(format!("cannot start a thread to read keys: {e}")))?;
    Ok(next)
}

struct Screen {
    state: State,
    source: Box<dyn Source>,
    painter: Painter,
    kind: Kind,
    screenshots: std::path::PathBuf,
    painting: bool,
    again: bool,
    is_followed: bool,
    /// Asks for the next key.
    keys: Option<std::sync::mpsc::SyncSender<()>>,
}

impl Screen {
    fn run(&mut self, told: &Receiver<Told>) -> Result<()> {
        self.source.want(self.state.wanted());
        self.ask_for_key();
        for told in told {
            let effect = match told {
                Told::NoKeys => return Ok(()),
                Told::Key(TerminalKey::CtrlC) => return Ok(()),
                Told::Key(key) => {
                    let action = translate(&key).and_then(|(key, shift)| keys::action(key, shift));
                    let effect = action.map_or(Effect::Nothing, |action| self.state.act(action));
                    if effect == Effect::Close {
                        return Ok(());
                    }
                    self.ask_for_key();
                    effect
                }
                Told::Source(_, Arrived::Failed(message)) if !self.state.has_others() && self.state.scene.is_none() => {
                    return Err(Failure(message));
                }
                Told::Source(number, arrived) => self.state.take(number, arrived),
                Told::Painted(painted) => {
                    if self.painted(painted)? {
                        return Ok(());
                    }
                    Effect::Nothing
                }
            };
            self.apply(effect)?;
            if self.is_complete() {
                // The coarser levels of one picture are not shown.
                self.order();
            }
        }
        Ok(())
    }

    /// Whether one picture was asked for, and what it shows is there.
    fn is_complete(&self) -> bool {
        !self.is_followed && !self.state.busy && !self.painting
    }

    fn ask_for_key(&self) {
        if let Some(keys) = &self.keys {
            let _ = keys.send(());
        }
    }

    fn apply(&mut self, effect: Effect) -> Result<()> {
        match effect {
            Effect::Nothing | Effect::Close => {}
            Effect::Overlay => return self.write_line(),
            Effect::Move | Effect::Draw => {
                if self.is_followed {
                    self.order();
                }
            }
            Effect::Load => {
                self.source.want(self.state.wanted());
                return self.write_line();
            }
            Effect::Play => {
                if let Some(clock) = &self.state.clock {
                    self.source.play(clock);
                }
                if self.is_followed {
                    self.order();
                }
            }
            Effect::Screenshot => match screenshot_path(&self.screenshots, self.state.path()) {
                Ok(path) => self.paint(Destination::File(path)),
                Err(Failure(message)) => self.state.message = Some(message),
            },
        }
        Ok(())
    }

    fn order(&mut self) {
        if self.state.look_again() {
            self.source.want(self.state.wanted());
            if !self.is_followed {
                // The one picture is drawn of what it shows.
                return;
            }
        }
        if self.painting {
            self.again = true;
            return;
        }
        let size = self.state.size;
        self.painting = self.state.scene.is_some();
        self.paint(Destination::Window { size, moving: false });
    }

    fn paint(&mut self, to: Destination) {
        let camera = self.state.camera.camera(self.state.size);
        if let (Some(scene), Ok(camera)) = (&self.state.scene, camera) {
            self.painter.paint(Order {
                gaussians: scene.gaussians.clone(),
                camera,
                clip: self.state.clip.corners(),
                background: self.state.background(),
                to,
            });
        }
    }

    /// Shows a picture: `true` if it was the only one.
    fn painted(&mut self, painted: Painted) -> Result<bool> {
        match painted {
            Painted::Picture(picture) => {
                self.painting = false;
                let width = picture.size[0] as usize;
                let text = match self.kind {
                    Kind::Blocks => half_blocks(&picture.pixels, width),
                    Kind::Sixel => super::sixel::encode(&picture.pixels, width),
                };
                if !self.is_followed {
                    let end = if self.kind == Kind::Sixel { "\n" } else { "" };
                    print(&format!("{text}{end}"))?;
                    return Ok(true);
                }
                print(&format!("\x1b[H{text}"))?;
                self.write_line()?;
                if std::mem::take(&mut self.again) {
                    self.order();
                }
            }
            Painted::Saved(path) => {
                self.state.message = Some(format!("saved {}", path.display()));
                self.write_line()?;
            }
            Painted::Failed(message) => return Err(Failure(message)),
        }
        Ok(false)
    }

    /// What is shown, in the last line.
    fn write_line(&mut self) -> Result<()> {
        if !self.is_followed {
            return Ok(());
        }
        let line = match &self.state.message {
            Some(message) => message.clone(),
            None if self.state.help => {
                let sequence = self.state.clock.iter().flat_map(|_| &SEQUENCE_HELP);
                let short = sequence
                    .chain(&HELP)
                    .filter(|(keys, _)| !keys.contains("drag") && !keys.contains("click on"));
                let words: Vec<_> = short.map(|(keys, what)| format!("{keys}: {what}")).collect();
                words.join("  ")
            }
            None => format!("{}  (? for keys)", self.state.line()),
        };
        let columns = match self.kind {
            Kind::Blocks => self.state.size[0],
            Kind::Sixel => self.state.size[0] / CELL[0],
        };
        let line: String = line
            .chars()
            .filter(|c| !c.is_control())
            .take(columns as usize)
            .collect();
        print(&format!("\x1b[999;1H\x1b[0m\x1b[K{line}"))
    }
}

/// Two pixels for each character: the upper half block in the colour of one on that of the other.
fn half_blocks(pixels: &[u32], width: usize) -> String {
    let mut text = String::new();
    let rows: Vec<&[u32]> = pixels.chunks_exact(width.max(1)).collect();
    for pair in rows.chunks(2) {
        let mut last = None;
        for x in 0..width {
            let upper = pair[0][x];
            let lower = pair.get(1).map_or(upper, |row| row[x]);
            if last != Some((upper, lower)) {
                let [r, g, b] = [upper >> 16, upper >> 8 & 255, upper & 255];
                let [s, h, c] = [lower >> 16, lower >> 8 & 255, lower & 255];
                // A string takes all.
                let _ = write!(text, "\x1b[38;2;{r};{g};{b};48;2;{s};{h};{c}m");
                last = Some((upper, lower));
            }
            text.push('▀');
        }
        text += "\x1b[0m\r\n";
    }
    text
}

/// A key of the terminal as a key, and whether Shift was held.
fn translate(key: &TerminalKey) -> Option<(Key, bool)> {
    let plain = |key| Some((key, false));
    match key {
        TerminalKey::ArrowLeft => plain(Key::Left),
        TerminalKey::ArrowRight => plain(Key::Right),
        TerminalKey::ArrowUp => plain(Key::Up),
        TerminalKey::ArrowDown => plain(Key::Down),
        TerminalKey::PageUp => plain(Key::PageUp),
        TerminalKey::PageDown => plain(Key::PageDown),
        TerminalKey::Home => plain(Key::Home),
        TerminalKey::Escape => plain(Key::Escape),
        TerminalKey::Char(character) => plain(Key::Char(*character)),
        // Shift with an arrow, as most terminals write it.
        TerminalKey::UnknownEscSeq(sequence) => match sequence.last()? {
            'A' => Some((Key::Up, true)),
            'B' => Some((Key::Down, true)),
            'C' => Some((Key::Right, true)),
            'D' => Some((Key::Left, true)),
            _ => None,
        },
        _ => None,
    }
}

fn print(text: &str) -> Result<()> {
    let mut out = std::io::stdout().lock();
    let written = out.write_all(text.as_bytes()).and_then(|()| out.flush());
    written.map_err(|source| Failure::writing(Path::new(PIPE), source))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_character_has_the_colours_of_two_pixels() {
        let text = half_blocks(&[0xff0000, 0xff0000, 0x0000ff, 0x0000ff], 2);
        assert_eq!(text, "\x1b[38;2;255;0;0;48;2;0;0;255m▀▀\x1b[0m\r\n");
        let odd = half_blocks(&[1, 2, 3], 1);
        assert_eq!(odd.matches('▀').count(), 2);
        assert!(odd.contains("38;2;0;0;3;48;2;0;0;3m"));
    }

    #[test]
    fn arrows_with_shift_differ_from_those_without() {
        assert_eq!(translate(&TerminalKey::ArrowLeft), Some((Key::Left, false)));
        let shifted = TerminalKey::UnknownEscSeq("[1;2D".chars().collect());
        assert_eq!(translate(&shifted), Some((Key::Left, true)));
        assert_eq!(translate(&TerminalKey::Alt), None);
    }
}
