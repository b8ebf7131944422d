//! The bytes of a stream as they arrive, and which level they allow to decode next.

use std::borrow::Cow;

use super::{Header, Level, MAGIC};
use crate::error::{Error, Result};
use crate::limits::Limits;

/// Where decoding is to end.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Goal {
    /// A level with Gaussians; without one named, the finest that has them, and the rest of the stream must be sound.
    Gaussians(Option<u8>),
    /// A level, Gaussians or not.
    Exact(u8),
}

/// A stream as far as it has come.
#[derive(Debug)]
pub(crate) struct Feed<'b> {
    goal: Goal,
    /// The stream as far as it is needed.
    bytes: Cow<'b, [u8]>,
    /// How much of the stream has come, needed or not.
    length: u64,
    opened: Option<Opened>,
    failed: bool,
}

/// What is known once the header is there.
#[derive(Debug)]
struct Opened {
    header: Header,
    /// The last level to decode.
    last: u8,
    /// Bytes of the stream that can be of use.
    end: u64,
}

pub(crate) fn failed_before() -> Error {
    Error::Usage("decoding has failed before, and goes no further".into())
}

impl<'b> Feed<'b> {
    pub(crate) fn new(goal: Goal, bytes: Cow<'b, [u8]>) -> Self {
        Feed {
            goal,
            length: bytes.len() as u64,
            bytes,
            opened: None,
            failed: false,
        }
    }

    /// Takes the next bytes. No more are kept than the header, once it is there, says are needed.
    pub(crate) fn push(&mut self, bytes: &[u8]) {
        self.length += bytes.len() as u64;
        let room = match &self.opened {
            Some(opened) => opened.end.saturating_sub(self.bytes.len() as u64),
            None => u64::MAX,
        };
        let room = usize::try_from(room).unwrap_or(usize::MAX);
        let kept = &bytes[..bytes.len().min(room)];
        if !kept.is_empty() {
            self.bytes.to_mut().extend_from_slice(kept);
        }
    }

    pub(crate) fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    pub(crate) fn header(&self) -> Option<&Header> {
        self.opened.as_ref().map(|opened| &opened.header)
    }

    /// Fails if decoding has failed before.
    pub(crate) fn check_usable(&self) -> Result<()> {
        match self.failed {
            true => Err(failed_before()),
            false => Ok(()),
        }
    }

    /// Nothing is decoded any more.
    pub(crate) fn fail(&mut self) {
        self.failed = true;
    }

    /// The level to decode next, if that is possible already: `reached` is the one decoded last, and `ended` tells that all bytes have come.
    /// `plan` is asked once for the last level to decode, and holds what that takes against the limits.
    pub(crate) fn next_level(
        &mut self,
        ended: bool,
        reached: Option<u8>,
        limits: &Limits,
        plan: impl FnOnce(&Header, Goal) -> Result<u8>,
    ) -> Result<Option<u8>> {
        if self.opened.is_none() {
            self.open(ended, limits, plan)?;
        }
        let Some(Opened { header, last, .. }) = &self.opened else {
            return Ok(None);
        };
        let next = reached.map_or(header.base, |level| level + 1);
        let named = !matches!(self.goal, Goal::Gaussians(None));
        if next > *last {
            if ended && !named {
                self.check_rest(header, next)?;
            }
            return Ok(None);
        }
        let whole = self.length >= header.prefix_bytes(next)?;
        let cut_before = next > header.base && self.length == header.prefix_bytes(next - 1)?;
        let wait = !whole && (!ended || (!named && cut_before));
        Ok((!wait).then_some(next))
    }

    /// The level after `level`, if it is to be decoded and all its bytes have come.
    pub(crate) fn after(&self, level: u8) -> Option<u8> {
        let Opened { header, last, .. } = self.opened.as_ref()?;
        let next = level + 1;
        let whole = next <= *last && self.length >= header.prefix_bytes(next).ok()?;
        whole.then_some(next)
    }

    /// Reads the header, if it is whole.
    fn open(&mut self, ended: bool, limits: &Limits, plan: impl FnOnce(&Header, Goal) -> Result<u8>) -> Result<()> {
        if !ended && self.bytes.len() < MAGIC.len() {
            return Ok(());
        }
        let header = match Header::parse(&self.bytes, limits) {
            Err(Error::Truncated { .. }) if !ended => return Ok(()),
            header => header?,
        };
        let last = plan(&header, self.goal)?;
        let end = match self.goal {
            Goal::Gaussians(None) => header.stream_bytes(),
            _ => header.prefix_bytes(last)?,
        };
        self.opened = Some(Opened { header, last, end });
        Ok(())
    }

    /// Fails unless the levels from `next` on are sound, or the stream ends between two of them.
    fn check_rest(&self, header: &Header, next: u8) -> Result<()> {
        for level in next..=header.top {
            if self.length == header.prefix_bytes(level - 1)? {
                return Ok(());
            }
            Level::read(&self.bytes, header, level)?;
        }
        header.check_end(self.length)
    }
}
