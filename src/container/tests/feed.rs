//! Which level is decoded next, of a stream that arrives in parts.

use std::borrow::Cow;

use super::transform::sample;
use super::*;
use crate::container::feed::{Feed, Goal};

/// A feed of these bytes, and what it says after `reached` was decoded, of `last` at most.
fn next(goal: Goal, bytes: &[u8], ended: bool, reached: Option<u8>, last: u8) -> (Feed<'_>, Result<Option<u8>>) {
    let mut feed = Feed::new(goal, Cow::Borrowed(bytes));
    let next = feed.next_level(ended, reached, &Limits::default(), |_, _| Ok(last));
    (feed, next)
}

fn is_level(found: (Feed<'_>, Result<Option<u8>>), level: Option<u8>) -> bool {
    found.1.is_ok_and(|found| found == level)
}

#[test]
fn levels_come_one_after_the_other_once_all_their_bytes_are_there() {
    let bytes = sample();
    let header = Header::parse(&bytes, &Limits::default()).unwrap();
    let whole = Goal::Gaussians(None);
    for (reached, level) in [(None, Some(2)), (Some(2), Some(3)), (Some(3), Some(4)), (Some(4), None)] {
        for ended in [false, true] {
            assert!(is_level(next(whole, &bytes, ended, reached, 4), level));
        }
        let level = level.filter(|level| *level < 4);
        assert!(is_level(next(Goal::Exact(3), &bytes, true, reached, 3), level));
    }
    let end = header.prefix_bytes(3).unwrap() as usize;
    for (length, ended, named, level) in [
        (end - 1, false, false, None),
        (end, false, false, Some(3)),
        // A level that is cut is decoded where an error must say so.
        (end - 1, true, false, Some(3)),
        (end - 1, true, true, Some(3)),
    ] {
        let goal = if named { Goal::Exact(4) } else { whole };
        assert!(
            is_level(next(goal, &bytes[..length], ended, Some(2), 4), level),
            "{length} bytes"
        );
    }
    // Between two levels a stream may end, unless the next one was asked for.
    assert!(is_level(next(whole, &bytes[..end], true, Some(3), 4), None));
    assert!(is_level(next(whole, &bytes[..end + 1], true, Some(3), 4), Some(4)));
    assert!(is_level(next(Goal::Exact(4), &bytes[..end], true, Some(3), 4), Some(4)));
    assert!(is_level(
        next(Goal::Gaussians(Some(4)), &bytes[..end], true, Some(3), 4),
        Some(4)
    ));
    assert!(is_level(next(whole, &bytes[..header.bytes()], true, None, 4), Some(2)));
}

#[test]
fn what_follows_the_last_level_that_is_decoded_must_be_valid_unless_a_level_was_named() {
    let bytes = sample();
    let mut damaged = bytes.clone();
    *damaged.last_mut().unwrap() ^= 1;
    let longer = [&bytes[..], &[0]].concat();
    for bytes in [&damaged, &longer] {
        assert!(next(Goal::Gaussians(None), bytes, true, Some(3), 3).1.is_err());
        assert!(is_level(next(Goal::Gaussians(None), bytes, false, Some(3), 3), None));
        assert!(is_level(next(Goal::Exact(3), bytes, true, Some(3), 3), None));
    }
    let end = Header::parse(&bytes, &Limits::default())
        .unwrap()
        .prefix_bytes(3)
        .unwrap() as usize;
    assert!(is_level(
        next(Goal::Gaussians(None), &bytes[..end], true, Some(3), 3),
        None
    ));
    assert!(
        next(Goal::Gaussians(None), &bytes[..end + 1], true, Some(3), 3)
            .1
            .is_err()
    );
}

#[test]
fn a_header_that_is_not_all_there_is_an_error_only_at_the_end() {
    let bytes = sample();
    for length in [0, 3, 8, 9, 71] {
        let goal = Goal::Exact(3);
        assert!(
            is_level(next(goal, &bytes[..length], false, None, 3), None),
            "{length} bytes"
        );
        let error = next(goal, &bytes[..length], true, None, 3).1.unwrap_err();
        assert!(matches!(error, Error::Truncated { .. }), "{length} bytes: {error}");
    }
    assert!(is_level(next(Goal::Exact(3), b"no", false, None, 3), None));
    assert!(next(Goal::Exact(3), b"no stream", false, None, 3).1.is_err());
}

#[test]
fn the_level_after_is_known_when_its_bytes_are_there_and_it_is_wanted() {
    let bytes = sample();
    let (feed, _) = next(Goal::Exact(3), &bytes, true, None, 3);
    assert_eq!([2, 3].map(|level| feed.after(level)), [Some(3), None]);
    let end = Header::parse(&bytes, &Limits::default())
        .unwrap()
        .prefix_bytes(3)
        .unwrap() as usize;
    let (feed, _) = next(Goal::Exact(4), &bytes[..end - 1], false, None, 4);
    assert_eq!(feed.after(2), None);
    let (feed, _) = next(Goal::Exact(4), &bytes[..end], false, None, 4);
    assert_eq!([2, 3].map(|level| feed.after(level)), [Some(3), None]);
    assert_eq!(Feed::new(Goal::Exact(4), Cow::Borrowed(&bytes)).after(2), None);
}

#[test]
fn no_more_bytes_are_kept_than_decoding_needs() {
    let bytes = sample();
    let header = Header::parse(&bytes, &Limits::default()).unwrap();
    let end = |level| header.prefix_bytes(level).unwrap() as usize;
    for (goal, last, kept) in [(Goal::Exact(3), 3, end(3)), (Goal::Gaussians(None), 3, bytes.len())] {
        let (mut feed, _) = next(goal, &bytes[..header.bytes()], false, None, last);
        for piece in bytes[header.bytes()..].chunks(7) {
            feed.push(piece);
        }
        feed.push(b"more");
        assert_eq!(feed.bytes(), &bytes[..kept]);
    }
}

#[test]
fn nothing_is_decoded_after_a_failure() {
    let bytes = sample();
    let mut feed = Feed::new(Goal::Exact(3), Cow::Borrowed(&bytes));
    assert!(feed.check_usable().is_ok());
    feed.fail();
    assert!(matches!(feed.check_usable(), Err(Error::Usage(_))));
}
