//! A stream that arrives in parts, and the next level that can be decoded from them (`docs/format.md`, clause 1.6.3).

use std::borrow::Cow;

use super::{Header, Level, MAGIC};
use crate::error::{Error, Result};
use crate::limits::Limits;

/// The level at which decoding ends.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Goal {
    /// The given level, which must have Gaussians. `None` is the finest level that has them; then the rest of the
    /// stream must be valid, too.
    Gaussians(Option<u8>),
    /// The given level, with or without Gaussians.
    Exact(u8),
}

/// The received part of a stream.
#[derive(Debug, Clone)]
pub(crate) struct Feed<'b> {
    goal: Goal,
    /// The received bytes, without those that decoding does not need.
    bytes: Cow<'b, [u8]>,
    /// Number of received bytes, needed or not.
    length: u64,
    opened: Option<Opened>,
    failed: bool,
}

/// State after the header was parsed.
#[derive(Debug, Clone)]
struct Opened {
    header: Header,
    /// The last level to decode.
    last: u8,
    /// Number of bytes that decoding can need.
    end: u64,
}

pub(crate) fn failed_before() -> Error {
    Error::Usage("decoding has failed before and cannot continue".into())
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

    /// Appends received bytes. After the header was parsed, bytes that decoding does not need are dropped.
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

    /// Stops all further decoding.
    pub(crate) fn fail(&mut self) {
        self.failed = true;
    }

    /// The level to decode next, if enough bytes have been received. `reached` is the level decoded last, `ended`
    /// whether all bytes have been received. `plan` is called once: it returns the last level to decode and checks its
    /// cost against the limits.
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
        let complete = self.length >= header.prefix_bytes(next)?;
        let cut_before = next > header.base && self.length == header.prefix_bytes(next - 1)?;
        let wait = !complete && (!ended || (!named && cut_before));
        Ok((!wait).then_some(next))
    }

    /// The level after `level`, if it is to be decoded and all its bytes have been received.
    pub(crate) fn after(&self, level: u8) -> Option<u8> {
        let Opened { header, last, .. } = self.opened.as_ref()?;
        let next = level + 1;
        let complete = next <= *last && self.length >= header.prefix_bytes(next).ok()?;
        complete.then_some(next)
    }

    /// Parses the header, if it is complete.
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

    /// Checks that the levels from `next` on are valid, or that the stream ends between two of them.
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
