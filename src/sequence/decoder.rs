//! Decodes the frames of a sequence (`docs/format.md`, clause 17.4).

use std::ops::Range;

use super::{Group, SequenceReader};
use crate::decoder::{Decoder, Decoding, Points};
use crate::error::{Error, Result};
use crate::gaussians::Gaussians;

/// Decodes frames of a sequence. It keeps the frame that it decoded last: the next one of the group continues from it.
#[derive(Debug, Clone)]
pub struct SequenceDecoder {
    decoder: Decoder,
}

/// A decoded frame.
#[derive(Debug)]
pub struct DecodedFrame {
    /// Its number, from 0.
    pub number: u64,
    decoding: Decoding<'static>,
}

impl SequenceDecoder {
    /// A decoder of sequences, which decodes and draws as `decoder` does: its level, heads, limits and instructions
    /// count.
    pub fn new(decoder: Decoder) -> Self {
        SequenceDecoder { decoder }
    }

    /// Decodes a frame.
    ///
    /// # Errors
    /// [`Error::Frame`] if the frame, or one that it is predicted from, is damaged; those of
    /// [`SequenceReader::group`]. Frames of other groups can be decoded after that.
    pub fn frame(&mut self, sequence: &SequenceReader, frame: u64) -> Result<DecodedFrame> {
        let group = sequence.group(sequence.group_of(frame)?)?;
        self.in_group(&group, frame)
    }

    /// Decodes the frames `frames` one after the other.
    pub fn frames<'a>(&'a mut self, sequence: &'a SequenceReader<'a>, frames: Range<u64>) -> Frames<'a> {
        Frames {
            decoder: self,
            sequence,
            frames,
        }
    }

    fn in_group(&mut self, group: &Group, frame: u64) -> Result<DecodedFrame> {
        let at = (frame - group.first()) as usize;
        if !group.is_whole(at) {
            let detail = format!("frame {frame} is predicted from the frame before");
            let what = "this kind of frame";
            return Err(Error::Unsupported { what, detail });
        }
        let (stream, _) = group.stream(at);
        let mut decoding = self.decoder.start();
        decoding.push(&stream);
        decoding.finish().map_err(|source| Error::Frame {
            frame,
            source: Box::new(source),
        })?;
        Ok(DecodedFrame {
            number: frame,
            decoding,
        })
    }
}

impl DecodedFrame {
    /// The voxels with their colours.
    pub fn points(&self) -> Option<Points<'_>> {
        self.decoding.points()
    }

    /// The frame's Gaussians.
    ///
    /// # Errors
    /// Those of [`Decoding::gaussians`].
    pub fn gaussians(&self) -> Result<Gaussians> {
        self.decoding.gaussians()
    }

    /// The level that was decoded.
    pub fn level(&self) -> Option<u8> {
        self.decoding.level()
    }
}

/// Frames of a sequence, one after the other. An error does not end it: frames of later groups follow.
#[derive(Debug)]
pub struct Frames<'a> {
    decoder: &'a mut SequenceDecoder,
    sequence: &'a SequenceReader<'a>,
    frames: Range<u64>,
}

impl Iterator for Frames<'_> {
    type Item = Result<DecodedFrame>;

    fn next(&mut self) -> Option<Self::Item> {
        let frame = self.frames.next()?;
        Some(self.decoder.frame(self.sequence, frame))
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        self.frames.size_hint()
    }
}
