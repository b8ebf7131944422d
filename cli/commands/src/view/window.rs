//! The window of `b2p view`: events in, pixels out. It sleeps unless there is something to do.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use softbuffer::{Context, Surface};
use winit::application::ApplicationHandler;
use winit::dpi::PhysicalSize;
use winit::event::{ElementState, KeyEvent, MouseButton, MouseScrollDelta, StartCause, WindowEvent};
use winit::event_loop::{ActiveEventLoop, ControlFlow, EventLoop};
use winit::keyboard::{Key as WindowKey, ModifiersState, NamedKey};
use winit::window::{Window, WindowId};

use super::keys::{self, Action, Key};
use super::overlay::{self, Sheet};
use super::painter::{Destination, Order, Painted, Painter, Picture, stretch};
use super::player::Sources;
use super::source::{Arrived, Source};
use super::state::{Effect, State};
use super::tally::Tally;
use super::{Viewer, folder, screenshot_path};
use crate::manners::{self, Said};
use crate::{Failure, Result};

/// How long after the last move the picture is drawn in full.
const REST: Duration = Duration::from_millis(150);
/// Two clicks within this time are a double click.
const DOUBLE: Duration = Duration::from_millis(400);
/// The distance grows by this power of e for a notch of the wheel, and for a pixel of a touchpad.
const NOTCH: f64 = 0.1;
const WHEEL_PIXEL: f64 = 0.002;
/// The share of a screen that a window takes at most, unless its size is asked for.
const SHARE: f64 = 0.9;

/// What other threads tell the window.
enum Told {
    Source(u64, Arrived),
    Painted(Painted),
}

/// Opens a window and shows files until it is closed.
pub fn run(viewer: Viewer) -> Result<Said> {
    let events = EventLoop::<Told>::with_user_event().build().map_err(no_display)?;
    let proxy = events.create_proxy();
    let painter = Painter::start(viewer.isa, viewer.loading.limits.clone(), move |painted| {
        // A window that is closed hears nothing.
        let _ = proxy.send_event(Told::Painted(painted));
    })?;
    let proxy = events.create_proxy();
    let tell = move |number, arrived| {
        let _ = proxy.send_event(Told::Source(number, arrived));
    };
    let source = Sources::start(viewer.loading, Arc::new(tell))?;
    let mut app = App {
        state: viewer.state,
        source: Box::new(source),
        painter,
        screenshots: viewer.screenshots,
        asked_size: viewer.size.is_some(),
        shell: None,
        picture: None,
        painting: false,
        again: None,
        rest: None,
        pointer: Pointer::default(),
        modifiers: ModifiersState::empty(),
        tally: Tally::default(),
        failure: None,
    };
    events.run_app(&mut app).map_err(no_display)?;
    match app.failure {
        Some(failure) => Err(failure),
        None => Ok(app.tally.said()),
    }
}

fn no_display(error: impl std::fmt::Display) -> Failure {
    let error = error.to_string();
    // What comes first is where in another crate it was noticed.
    let what = error.split_once(": ").map_or(&*error, |(_, what)| what);
    Failure(format!(
        "no window can be opened ({what}); --terminal draws in the terminal"
    ))
}

/// The window and what it shows pixels with.
struct Shell {
    window: Arc<Window>,
    surface: Surface<Arc<Window>, Arc<Window>>,
    title: String,
}

#[derive(Default)]
struct Pointer {
    at: [f64; 2],
    /// What dragging does now.
    drag: Option<Drag>,
    pressed: Option<(Instant, [f64; 2])>,
}

#[derive(Clone, Copy)]
enum Drag {
    Turn,
    Pan,
    /// Along the time line.
    Seek,
}

struct App {
    state: State,
    source: Box<dyn Source>,
    painter: Painter,
    screenshots: PathBuf,
    asked_size: bool,
    shell: Option<Shell>,
    picture: Option<Picture>,
    /// A picture for the window is being drawn.
    painting: bool,
    /// Another is to follow, and whether the camera moves.
    again: Option<bool>,
    /// When the picture is to be drawn in full.
    rest: Option<Instant>,
    pointer: Pointer,
    modifiers: ModifiersState,
    tally: Tally,
    failure: Option<Failure>,
}

impl App {
    fn open_window(&mut self, events: &ActiveEventLoop) -> Result<Shell> {
        let mut size = self.state.size;
        let screen = events.primary_monitor().or_else(|| events.available_monitors().next());
        if let (false, Some(screen)) = (self.asked_size, screen) {
            let PhysicalSize { width, height } = screen.size();
            let most = (f64::from(width.min(height)) * SHARE) as u32;
            size = size.map(|side| side.min(most.max(1)));
        }
        let title = self.state.title();
        let attributes = Window::default_attributes()
            .with_title(&title)
            .with_inner_size(PhysicalSize::new(size[0], size[1]));
        let window = Arc::new(events.create_window(attributes).map_err(no_display)?);
        let context = Context::new(window.clone()).map_err(no_display)?;
        let surface = Surface::new(&context, window.clone()).map_err(no_display)?;
        Ok(Shell { window, surface, title })
    }

    fn apply(&mut self, effect: Effect, events: &ActiveEventLoop) {
        match effect {
            Effect::Nothing => {}
            Effect::Overlay => self.refresh(),
            Effect::Move => {
                self.rest = Some(Instant::now() + REST);
                self.order(true);
            }
            Effect::Draw => {
                self.rest = None;
                self.order(false);
            }
            Effect::Load => {
                self.source.want(self.state.wanted());
                self.order(false);
            }
            Effect::Play => {
                if let Some(clock) = &self.state.clock {
                    self.source.play(clock);
                }
                self.order(false);
            }
            Effect::Screenshot => self.screenshot(),
            Effect::Close => events.exit(),
        }
        let title = self.state.title();
        if let Some(shell) = self.shell.as_mut().filter(|shell| shell.title != title) {
            shell.window.set_title(&title);
            shell.title = title;
        }
        events.set_control_flow(self.rest.map_or(ControlFlow::Wait, ControlFlow::WaitUntil));
    }

    fn refresh(&self) {
        if let Some(shell) = &self.shell {
            shell.window.request_redraw();
        }
    }

    /// Asks for a picture; if one is being drawn, after it, and only the last.
    fn order(&mut self, moving: bool) {
        if !moving && self.state.look_again() {
            self.source.want(self.state.wanted());
        }
        if self.painting {
            self.again = Some(moving);
            return;
        }
        let size = self.state.size;
        let drawn = if moving { self.state.pace.size(size) } else { size };
        let (Some(scene), Ok(camera)) = (&self.state.scene, self.state.camera.camera(drawn)) else {
            self.picture = None;
            return self.refresh();
        };
        self.painting = true;
        self.painter.paint(Order {
            gaussians: scene.gaussians.clone(),
            camera,
            clip: self.state.clip.corners(),
            background: self.state.background(),
            to: Destination::Window { size, moving },
        });
    }

    fn screenshot(&mut self) {
        let size = self.state.size;
        let path = screenshot_path(&self.screenshots, self.state.path());
        let (Some(scene), Ok(camera)) = (&self.state.scene, self.state.camera.camera(size)) else {
            return;
        };
        match path {
            Ok(path) => self.painter.paint(Order {
                gaussians: scene.gaussians.clone(),
                camera,
                clip: self.state.clip.corners(),
                background: self.state.background(),
                to: Destination::File(path),
            }),
            Err(Failure(message)) => self.state.message = Some(message),
        }
        self.refresh();
    }

    fn painted(&mut self, painted: Painted) {
        match painted {
            Painted::Picture(picture) => {
                self.painting = false;
                if picture.moving {
                    self.state.pace.learn(picture.drawn, picture.size, picture.took);
                }
                self.picture = Some(picture);
                if let Some(moving) = self.again.take() {
                    self.order(moving);
                }
            }
            Painted::Saved(path) => {
                let mut options = self.state.camera.options(self.state.size);
                if let Some(frame) = self.state.scene.as_ref().and_then(|scene| scene.frame) {
                    options += &format!(" --frame {}", frame.number);
                }
                let from = quoted(self.state.path());
                manners::note_report(&format!(
                    "{}: as `b2p render {from} {options}` draws it",
                    path.display()
                ));
                self.state.message = Some(format!("saved {}", path.display()));
            }
            Painted::Failed(message) => {
                self.painting = false;
                self.again = None;
                self.state.message = Some(message);
            }
        }
        self.refresh();
    }

    /// Shows the last picture and what is written over it.
    fn show(&mut self) -> std::result::Result<(), softbuffer::SoftBufferError> {
        let (state, picture) = (&self.state, self.picture.as_ref());
        let Some(Shell { window, surface, .. }) = &mut self.shell else {
            return Ok(());
        };
        let [width, height] = state.size;
        let (Ok(columns), Ok(rows)) = (width.try_into(), height.try_into()) else {
            return Ok(());
        };
        surface.resize(columns, rows)?;
        let mut buffer = surface.buffer_mut()?;
        match picture {
            Some(picture) if picture.size == state.size => buffer.copy_from_slice(&picture.pixels),
            Some(picture) => stretch(picture, state.size, &mut buffer),
            None => buffer.fill(0x808080),
        }
        let mut sheet = Sheet {
            pixels: &mut buffer,
            size: state.size,
        };
        overlay::draw(state, picture, &mut sheet, zoom(window));
        window.pre_present_notify();
        buffer.present()?;
        if let Some(picture) = picture {
            self.tally.shown(picture, Instant::now());
        }
        Ok(())
    }

    fn key(&mut self, event: &KeyEvent, events: &ActiveEventLoop) {
        let key = match &event.logical_key {
            WindowKey::Named(NamedKey::ArrowLeft) => Key::Left,
            WindowKey::Named(NamedKey::ArrowRight) => Key::Right,
            WindowKey::Named(NamedKey::ArrowUp) => Key::Up,
            WindowKey::Named(NamedKey::ArrowDown) => Key::Down,
            WindowKey::Named(NamedKey::PageUp) => Key::PageUp,
            WindowKey::Named(NamedKey::PageDown) => Key::PageDown,
            WindowKey::Named(NamedKey::Home) => Key::Home,
            WindowKey::Named(NamedKey::Escape) => Key::Escape,
            WindowKey::Named(NamedKey::F1) => Key::Char('?'),
            WindowKey::Named(NamedKey::Space) => Key::Char(' '),
            WindowKey::Character(text) => match text.chars().next() {
                Some(character) => Key::Char(character),
                None => return,
            },
            _ => return,
        };
        if let Some(action) = keys::action(key, self.modifiers.shift_key()) {
            let effect = self.state.act(action);
            self.apply(effect, events);
        }
    }

    fn button(&mut self, button: MouseButton, state: ElementState, events: &ActiveEventLoop) {
        self.pointer.drag = match (state, button) {
            (ElementState::Released, _) => None,
            (_, MouseButton::Left) if self.is_on_the_time_line() => Some(Drag::Seek),
            (_, MouseButton::Left) if !self.modifiers.shift_key() => Some(Drag::Turn),
            (_, MouseButton::Left | MouseButton::Right | MouseButton::Middle) => Some(Drag::Pan),
            _ => return,
        };
        if (state, button) != (ElementState::Pressed, MouseButton::Left) {
            return;
        }
        if matches!(self.pointer.drag, Some(Drag::Seek)) {
            return self.seek(events);
        }
        let (now, at) = (Instant::now(), self.pointer.at);
        let before = self.pointer.pressed.replace((now, at));
        let near = |other: [f64; 2]| (0..2).all(|k| (at[k] - other[k]).abs() < 4.0);
        if before.is_some_and(|(time, place)| now - time < DOUBLE && near(place)) {
            self.pointer.pressed = None;
            let effect = self.state.act(Action::Reset);
            self.apply(effect, events);
        }
    }

    fn moved(&mut self, to: [f64; 2], events: &ActiveEventLoop) {
        let from = std::mem::replace(&mut self.pointer.at, to);
        let by = [to[0] - from[0], to[1] - from[1]];
        let size = self.state.size;
        match self.pointer.drag {
            None => return,
            Some(Drag::Turn) => self.state.camera.drag(by, size),
            Some(Drag::Pan) => self.state.camera.pan(by, size),
            Some(Drag::Seek) => return self.seek(events),
        }
        self.apply(Effect::Move, events);
    }

    fn is_on_the_time_line(&self) -> bool {
        let Some(shell) = self.shell.as_ref().filter(|_| self.state.clock.is_some()) else {
            return false;
        };
        let height = overlay::time_line_height(zoom(&shell.window));
        self.pointer.at[1] >= f64::from(self.state.size[1].saturating_sub(height))
    }

    /// Goes where the pointer is on the time line.
    fn seek(&mut self, events: &ActiveEventLoop) {
        let effect = self
            .state
            .seek(self.pointer.at[0] / f64::from(self.state.size[0].max(1)));
        self.apply(effect, events);
    }

    fn dropped(&mut self, path: PathBuf, events: &ActiveEventLoop) {
        let effect = match folder::files_in(&[path]) {
            Ok(files) => self.state.open(files, 0),
            Err(Failure(message)) => {
                self.state.message = Some(message);
                Effect::Overlay
            }
        };
        self.apply(effect, events);
    }
}

impl ApplicationHandler<Told> for App {
    fn resumed(&mut self, events: &ActiveEventLoop) {
        if self.shell.is_some() {
            return;
        }
        match self.open_window(events) {
            Ok(shell) => {
                let PhysicalSize { width, height } = shell.window.inner_size();
                self.shell = Some(shell);
                self.state.resize([width, height]);
                self.apply(Effect::Load, events);
            }
            Err(failure) => {
                self.failure = Some(failure);
                events.exit();
            }
        }
    }

    fn new_events(&mut self, events: &ActiveEventLoop, cause: StartCause) {
        if matches!(cause, StartCause::ResumeTimeReached { .. }) && self.rest.is_some_and(|at| at <= Instant::now()) {
            self.apply(Effect::Draw, events);
        }
    }

    fn user_event(&mut self, events: &ActiveEventLoop, told: Told) {
        match told {
            Told::Painted(painted) => self.painted(painted),
            Told::Source(number, arrived) => {
                let alone = !self.state.has_others() && self.state.scene.is_none();
                if let (true, Arrived::Failed(message)) = (alone, &arrived) {
                    // There is nothing else to look at.
                    self.failure = Some(Failure(message.clone()));
                    return events.exit();
                }
                self.tally.arrived(&arrived, Instant::now());
                let effect = self.state.take(number, arrived);
                self.apply(effect, events);
            }
        }
    }

    fn window_event(&mut self, events: &ActiveEventLoop, _: WindowId, event: WindowEvent) {
        match event {
            WindowEvent::CloseRequested | WindowEvent::Destroyed => events.exit(),
            WindowEvent::RedrawRequested => {
                if let Err(error) = self.show() {
                    self.failure = Some(Failure(format!("the window cannot be drawn: {error}")));
                    events.exit();
                }
            }
            WindowEvent::Resized(PhysicalSize { width, height }) => {
                if [width, height] != self.state.size && width > 0 && height > 0 {
                    let effect = self.state.resize([width, height]);
                    self.apply(effect, events);
                }
                self.refresh();
            }
            WindowEvent::KeyboardInput { event, .. } if event.state == ElementState::Pressed => {
                self.key(&event, events)
            }
            WindowEvent::ModifiersChanged(modifiers) => self.modifiers = modifiers.state(),
            WindowEvent::MouseInput { state, button, .. } => self.button(button, state, events),
            WindowEvent::CursorMoved { position, .. } => self.moved([position.x, position.y], events),
            WindowEvent::MouseWheel { delta, .. } => {
                let power = match delta {
                    MouseScrollDelta::LineDelta(_, lines) => -f64::from(lines) * NOTCH,
                    MouseScrollDelta::PixelDelta(by) => -by.y * WHEEL_PIXEL,
                };
                let effect = self.state.act(Action::Zoom(power.exp()));
                self.apply(effect, events);
            }
            WindowEvent::DroppedFile(path) => self.dropped(path, events),
            _ => {}
        }
    }
}

/// How much letters and the time line are enlarged.
fn zoom(window: &Window) -> u32 {
    ((1.5 * window.scale_factor()).round() as u32).max(1)
}

/// A path as a shell takes it.
fn quoted(path: &Path) -> String {
    let path = path.display().to_string();
    let is_plain = |c: char| c.is_alphanumeric() || "-_./+,:@%".contains(c);
    match !path.is_empty() && path.chars().all(is_plain) {
        true => path,
        false => format!("'{}'", path.replace('\'', "'\\''")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_are_quoted_where_a_shell_would_break_them() {
        assert_eq!(quoted(Path::new("a/b-1.b2p")), "a/b-1.b2p");
        assert_eq!(quoted(Path::new("it's mine.ply")), "'it'\\''s mine.ply'");
    }

    #[test]
    fn without_a_display_the_error_names_what_draws_without() {
        let Failure(text) = no_display("os error at x.rs:1: no display");
        assert_eq!(
            text,
            "no window can be opened (no display); --terminal draws in the terminal"
        );
    }
}
