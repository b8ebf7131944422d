//! What keys do, in the window and in the terminal alike.

/// A key, as the user means it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Key {
    Char(char),
    Left,
    Right,
    Up,
    Down,
    PageUp,
    PageDown,
    Home,
    Escape,
}

/// What a key asks for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Action {
    /// Azimuth and elevation, in degrees.
    Turn(f64, f64),
    /// Shares of the picture's height, to the right and down.
    Pan(f64, f64),
    /// A factor on the distance.
    Zoom(f64),
    /// Of sequences a higher or lower speed, else nearer or further away.
    Faster,
    Slower,
    Reset,
    Finer,
    Coarser,
    Heads,
    Background,
    /// The clipping box on or off.
    Clip,
    /// The axis whose faces keys move.
    ClipAxis(usize),
    /// One face of the box: a share of the cube along its axis.
    ClipFace {
        high: bool,
        by: f32,
    },
    /// Pauses a sequence or plays it.
    Pause,
    /// In a loop or not.
    Loop,
    Times,
    Help,
    Screenshot,
    NextFile,
    PreviousFile,
    Close,
}

/// Degrees that an arrow turns by, the share of the picture that it moves by with Shift, the factor of a zoom, and how
/// far a face of the clipping box moves.
const TURN: f64 = 5.0;
const PAN: f64 = 0.05;
pub const ZOOM: f64 = 1.1;
const FACE: f32 = 0.02;

/// The keys and what they do, for people.
pub const HELP: [(&str, &str); 17] = [
    ("drag", "turn"),
    ("right or middle drag, Shift drag", "move"),
    ("wheel, + -", "zoom"),
    ("arrows", "turn"),
    ("Shift arrows", "move"),
    ("r, Home, double click", "reset the camera"),
    ("[ ]", "coarser, finer level"),
    ("h", "other heads"),
    ("b", "other background"),
    ("c", "clipping box"),
    ("x y z", "axis of the box"),
    (", . < >", "lower face, upper face"),
    ("t", "times"),
    ("s", "screenshot"),
    ("n p, PgDn PgUp", "next, previous file"),
    ("?", "keys"),
    ("q, Esc", "close"),
];

/// The keys of sequences.
pub const SEQUENCE_HELP: [(&str, &str); 6] = [
    ("space", "pause, play"),
    (", .", "frame back, on (while there is no box)"),
    ("+ -", "faster, slower"),
    ("= _", "zoom"),
    ("l", "once, in a loop"),
    ("click on the time line", "go there"),
];

/// What a key does, if it does anything.
pub fn action(key: Key, shift: bool) -> Option<Action> {
    let arrow = |x: f64, y: f64| match shift {
        true => Action::Pan(PAN * x, PAN * y),
        // The object turns the way of the arrow.
        false => Action::Turn(-TURN * x, TURN * y),
    };
    Some(match key {
        Key::Left => arrow(-1.0, 0.0),
        Key::Right => arrow(1.0, 0.0),
        Key::Up => arrow(0.0, -1.0),
        Key::Down => arrow(0.0, 1.0),
        Key::PageDown => Action::NextFile,
        Key::PageUp => Action::PreviousFile,
        Key::Home => Action::Reset,
        Key::Escape => Action::Close,
        Key::Char(character) => return letter(character),
    })
}

fn letter(character: char) -> Option<Action> {
    let face = |high, by| Some(Action::ClipFace { high, by });
    Some(match character.to_ascii_lowercase() {
        '+' => Action::Faster,
        '-' => Action::Slower,
        '=' => Action::Zoom(1.0 / ZOOM),
        '_' => Action::Zoom(ZOOM),
        ' ' => Action::Pause,
        'l' => Action::Loop,
        'r' => Action::Reset,
        ']' => Action::Finer,
        '[' => Action::Coarser,
        'h' => Action::Heads,
        'b' => Action::Background,
        'c' => Action::Clip,
        'x' => Action::ClipAxis(0),
        'y' => Action::ClipAxis(1),
        'z' => Action::ClipAxis(2),
        ',' => return face(false, -FACE),
        '.' => return face(false, FACE),
        '<' => return face(true, -FACE),
        '>' => return face(true, FACE),
        't' => Action::Times,
        '?' => Action::Help,
        's' => Action::Screenshot,
        'n' => Action::NextFile,
        'p' => Action::PreviousFile,
        'q' => Action::Close,
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_key_of_the_help_does_something() {
        for (keys, what) in HELP.into_iter().chain(SEQUENCE_HELP) {
            for key in keys.split([' ', ',']).filter(|key| key.chars().count() == 1) {
                let key = key.chars().next().unwrap();
                assert!(action(Key::Char(key), false).is_some(), "{key}: {what}");
            }
        }
        assert_eq!(
            action(Key::Char(','), false),
            Some(Action::ClipFace { high: false, by: -FACE })
        );
        assert_eq!(action(Key::Char('k'), false), None);
    }

    #[test]
    fn the_guide_has_the_keys() {
        let guide = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/guide.md");
        // A package of this crate is without it.
        let Ok(guide) = std::fs::read_to_string(guide) else {
            return;
        };
        for (keys, what) in HELP.into_iter().chain(SEQUENCE_HELP) {
            let row = guide
                .lines()
                .any(|line| line.starts_with('|') && line.contains(&format!("{keys} | {what}")));
            assert!(row, "{keys}: {what}");
        }
    }

    #[test]
    fn arrows_turn_and_with_shift_they_move() {
        assert_eq!(action(Key::Left, false), Some(Action::Turn(TURN, 0.0)));
        assert_eq!(action(Key::Left, true), Some(Action::Pan(-PAN, 0.0)));
    }
}
