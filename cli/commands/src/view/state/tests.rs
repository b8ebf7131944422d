use std::sync::Arc;

use b2p::sequence::play::clock::Timeline;
use b2p::{Extent, Frame, Gaussians};

use super::*;
use crate::args::Orbit;
use crate::view::keys::{Key, action};
use crate::view::orbit::Start;
use crate::view::source::Shown;

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
        is_part: false,
        steps: Vec::new(),
        frame: None,
    }))
}

fn choices() -> Arrived {
    Arrived::Choices(Choices {
        levels: vec![7, 8, 9],
        heads: HeadSet::ALL.to_vec(),
        timeline: None,
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
fn of_a_scene_that_is_too_large_what_each_camera_sees_is_asked_for_once() {
    let mut state = state(&["a.b2p", "b.b2p"]);
    let part = |state: &mut State| {
        let Arrived::Scene(mut shown) = scene(0.5, 9) else {
            return;
        };
        shown.is_part = true;
        let number = state.wanted().number;
        state.take(number, Arrived::Scene(shown));
        state.take(number, Arrived::Done);
    };
    assert!(!state.look_again(), "nothing is there");
    state.take(0, scene(0.5, 9));
    state.take(0, Arrived::Done);
    assert!(!state.look_again(), "all of it is there");
    part(&mut state);
    assert!(state.look_again());
    let wanted = state.wanted();
    assert_eq!(wanted.camera, state.camera.camera(state.size).ok());
    assert!(!state.look_again(), "it is on its way");
    part(&mut state);
    assert!(!state.look_again(), "the camera has not moved");
    press(&mut state, '+');
    assert!(state.look_again());
    assert_ne!(state.wanted().camera, wanted.camera);
    press(&mut state, 'n');
    assert_eq!(state.wanted().camera, None, "another file");
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
            heads: None,
            camera: None
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

/// A frame of a sequence.
fn frame(number: u64) -> Arrived {
    let Arrived::Scene(mut scene) = scene(0.5, 8) else {
        unreachable!("it is a scene")
    };
    scene.frame = Some(Shown { number, dropped: 0 });
    Arrived::Scene(scene)
}

/// A sequence of ten frames whose first frame has arrived.
fn playing() -> State {
    let mut state = state(&["a.b2p"]);
    let frames = (0..10).map(|i| (f64::from(i) * 100.0, i == 0)).collect();
    let timeline = Some(Arc::new(Timeline::new(frames, 1000.0)));
    let choices = Choices {
        timeline,
        ..Choices::default()
    };
    assert_eq!(state.take(0, Arrived::Choices(choices)), Effect::Play);
    assert!(!state.is_running());
    assert_eq!(state.take(0, frame(0)), Effect::Play);
    assert_eq!(state.take(0, Arrived::Done), Effect::Overlay);
    state
}

#[test]
fn a_sequence_runs_when_its_first_frame_is_there() {
    let mut state = playing();
    assert!(state.is_running());
    assert_eq!(state.take(0, frame(1)), Effect::Move);
    assert!(state.line().ends_with(", frame 1 of 10"), "{}", state.line());
    assert_eq!(state.title(), "a.b2p – b2p");
    assert_eq!(press(&mut state, ' '), Effect::Play);
    assert!(!state.is_running());
    assert_eq!(state.title(), "a.b2p, paused at frame 0 of 10 – b2p");
    assert_eq!(state.take(0, frame(0)), Effect::Draw);
}

#[test]
fn keys_step_and_change_the_speed_and_a_click_seeks() {
    let mut state = playing();
    for key in ['.', '.', '.', ','] {
        assert_eq!(press(&mut state, key), Effect::Play);
    }
    assert_eq!(state.title(), "a.b2p, paused at frame 2 of 10 – b2p");
    assert_eq!(state.seek(0.75), Effect::Play);
    assert_eq!(state.title(), "a.b2p, paused at frame 7 of 10 – b2p");
    press(&mut state, '+');
    press(&mut state, 'l');
    let clock = state.clock.clone().expect("a clock");
    assert_eq!((clock.speed(), clock.is_looped()), (2.0, false));
    assert_eq!(press(&mut state, '='), Effect::Move);
    press(&mut state, 'c');
    assert_eq!(press(&mut state, ','), Effect::Draw);
}

#[test]
fn frames_that_are_skipped_are_said_and_the_next_ones_play() {
    let mut state = state(&["a.b2p"]);
    let choices = Choices {
        timeline: Some(Arc::new(Timeline::new(Vec::new(), 1.0))),
        ..Choices::default()
    };
    state.take(0, Arrived::Choices(choices));
    assert_eq!(state.take(0, Arrived::Skipped("frame 0".into())), Effect::Play);
    assert_eq!(state.message.as_deref(), Some("frame 0"));
    assert_eq!(state.take(0, Arrived::Skipped("frame 1".into())), Effect::Overlay);
}

#[test]
fn keys_of_sequences_do_nothing_to_other_files() {
    let mut state = state(&["a.b2p"]);
    assert_eq!(press(&mut state, ' '), Effect::Overlay);
    assert!(state.message.is_some());
    assert_eq!(state.seek(0.5), Effect::Overlay);
}
