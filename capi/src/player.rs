//! Sequences that are played: what the web page has of them.

use std::ffi::c_char;
use std::time::Instant;

use b2p::sequence::play::player;

use crate::boundary::{Fault, Status, borrowed, changed, give, guard, slice, take};
use crate::decoding::{Gaussians, HEADS, heads_of};
use crate::model::HeadsModel;

/// A sequence that is played by the clock of the system.
pub struct Player(player::Player);

/// What a sequence has.
#[repr(C)]
#[derive(Debug, Clone, Copy)]
pub struct SequenceInfo {
    /// Its length.
    pub seconds: f64,
    /// How many frames.
    pub frames: u32,
    /// The coarsest level that can be drawn.
    pub base: u32,
    /// The finest level.
    pub top: u32,
}

/// A frame that was decoded.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default)]
pub struct PlayedFrame {
    /// Its time in the sequence, in seconds.
    pub time: f64,
    /// Seconds until it is to be shown, from the call on.
    pub due: f64,
    /// Seconds that there are for a frame; 0 if the clock stands.
    pub budget: f64,
    /// Its number.
    pub number: u32,
    /// Frames that were due and not shown, since the sequence was opened.
    pub dropped: u32,
    /// The level.
    pub level: u32,
    /// The heads: one of b2p_heads.
    pub heads: u32,
    /// Whether there was a frame to decode. If not, there is none until the clock is changed.
    pub is_there: bool,
}

/// Opens a sequence, all of which is there: `bytes` are not needed afterwards. It stands at its first frame, and begins again at the end.
/// `model` may be NULL. `level` and `heads` are those to draw with; where they are negative, those that there is time for. Fails as
/// b2p_decoding_advance does, with TRUNCATED, and with USAGE.
///
/// # Safety
/// `bytes` leads to `length` bytes; `model` is NULL or learned heads; `player` is writable; `message` is NULL or leads to `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_player_open(
    bytes: *const u8,
    length: usize,
    model: *const HeadsModel,
    level: i32,
    heads: i32,
    player: *mut *mut Player,
    message: *mut c_char,
    size: usize,
) -> Status {
    let run = || {
        // SAFETY: the caller vouches for `bytes` and `model`.
        let (bytes, model) = unsafe { (slice(bytes, length, "bytes")?, model.as_ref()) };
        let mut decoder = b2p::Decoder::new();
        let mut heads = if heads < 0 { None } else { Some(heads_of(heads)?) };
        match model {
            Some(model) => decoder = decoder.with_heads_model(model.0.clone()),
            None => heads = heads.or(Some(b2p::HeadSet::Surfels)),
        }
        let level = match level {
            ..0 => None,
            _ => Some(u8::try_from(level).map_err(|_| Fault::usage("level is above 255"))?),
        };
        let opened = player::Player::new(bytes.to_vec(), decoder, level, heads)?;
        // SAFETY: the caller vouches for `player`.
        unsafe { give(player, "player", Player(opened)) }
    };
    // SAFETY: the caller vouches for `message`.
    unsafe { guard(message, size, run) }
}

/// What the sequence has. Fails with USAGE.
///
/// # Safety
/// `player` is a player; `info` is writable; `message` is NULL or leads to `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_player_info(
    player: *const Player,
    info: *mut SequenceInfo,
    message: *mut c_char,
    size: usize,
) -> Status {
    let run = || {
        // SAFETY: the caller vouches for `player` and `info`.
        let (Player(player), info) = unsafe { (borrowed(player, "player")?, changed(info, "info")?) };
        let (sequence, levels) = (player.sequence(), player.levels());
        *info = SequenceInfo {
            seconds: sequence.seconds(),
            frames: u32::try_from(sequence.frames()).unwrap_or(u32::MAX),
            base: (*levels.start()).into(),
            top: (*levels.end()).into(),
        };
        Ok(())
    };
    // SAFETY: the caller vouches for `message`.
    unsafe { guard(message, size, run) }
}

/// Does something to a player at this time.
///
/// # Safety
/// `player` is NULL or a player.
unsafe fn control(player: *mut Player, how: impl FnOnce(&mut player::Player, Instant)) -> Status {
    let run = || {
        // SAFETY: the caller vouches for `player`.
        let Player(player) = unsafe { changed(player, "player") }?;
        how(player, Instant::now());
        Ok(())
    };
    // SAFETY: NULL takes no message.
    unsafe { guard(std::ptr::null_mut(), 0, run) }
}

/// Plays from now on. Fails with USAGE.
///
/// # Safety
/// `player` is a player.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_player_play(player: *mut Player) -> Status {
    // SAFETY: as the caller vouches.
    unsafe { control(player, player::Player::play) }
}

/// Stays at the frame that was made last. Fails with USAGE.
///
/// # Safety
/// `player` is a player.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_player_pause(player: *mut Player) -> Status {
    // SAFETY: as the caller vouches.
    unsafe { control(player, player::Player::pause) }
}

/// Goes to the frame at a time in seconds. Fails with USAGE.
///
/// # Safety
/// `player` is a player.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_player_seek(player: *mut Player, time: f64) -> Status {
    // SAFETY: as the caller vouches.
    unsafe { control(player, |player, now| player.seek(time, now)) }
}

/// Pauses so many frames further on, or back. Fails with USAGE.
///
/// # Safety
/// `player` is a player.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_player_step(player: *mut Player, by: i32) -> Status {
    // SAFETY: as the caller vouches.
    unsafe { control(player, |player, now| player.step(by.into(), now)) }
}

/// Plays so many times as fast as it was recorded, from ⅛ to 8. Fails with USAGE.
///
/// # Safety
/// `player` is a player.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_player_speed(player: *mut Player, speed: f64) -> Status {
    // SAFETY: as the caller vouches.
    unsafe { control(player, |player, now| player.set_speed(speed, now)) }
}

/// Decodes the next frame as accurately as there is time for. `gaussians` are those of it; NULL if it is not to be shown. After a failure
/// the frame is skipped with those that are predicted from it, and `frame` tells which it was. Fails as b2p_decoding_advance does.
///
/// # Safety
/// `player` is a player; `frame` and `gaussians` are writable; `message` is NULL or leads to `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_player_next(
    player: *mut Player,
    frame: *mut PlayedFrame,
    gaussians: *mut *mut Gaussians,
    message: *mut c_char,
    size: usize,
) -> Status {
    let run = || {
        // SAFETY: the caller vouches for all three.
        let (Player(player), frame, out) = unsafe {
            let player = changed(player, "player")?;
            (player, changed(frame, "frame")?, changed(gaussians, "gaussians")?)
        };
        (*frame, *out) = (PlayedFrame::default(), std::ptr::null_mut());
        let now = Instant::now();
        let Some(step) = player.next(now) else {
            return Ok(());
        };
        let number = |x: u64| u32::try_from(x).unwrap_or(u32::MAX);
        let heads = HEADS.iter().find(|(_, set)| *set == step.rung.heads);
        *frame = PlayedFrame {
            time: step.time,
            due: step.due.as_secs_f64(),
            budget: player.budget(now).unwrap_or(0.0),
            number: number(step.frame),
            dropped: number(player.dropped()),
            level: step.rung.level.into(),
            heads: heads.map_or(0, |(heads, _)| *heads as u32),
            is_there: true,
        };
        if let Some(made) = step.made? {
            *out = Box::into_raw(Box::new(Gaussians(made)));
        }
        Ok(())
    };
    // SAFETY: the caller vouches for `message`.
    unsafe { guard(message, size, run) }
}

/// Tells how many seconds the last frame took, decoded and drawn: levels and heads are chosen by that. Fails with USAGE.
///
/// # Safety
/// `player` is a player.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_player_took(player: *mut Player, seconds: f64) -> Status {
    // SAFETY: as the caller vouches.
    unsafe { control(player, |player, _| player.learn(seconds)) }
}

/// Frees a player. Gaussians that it made stay.
///
/// # Safety
/// `player` is NULL or came from this library, and is not used any more.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn b2p_player_free(player: *mut Player) {
    // SAFETY: the caller vouches for `player`.
    unsafe { take(player) }
}
