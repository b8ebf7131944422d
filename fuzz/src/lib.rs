//! What every fuzz target does with its bytes. Here, apart from the fuzzer, so that tests on stable Rust run it too.
//!
//! Every target asserts more than that nothing panics; what it asserts is in its documentation.

mod codecs;
mod files;
mod mutate;
mod pictures;
mod scenes;
#[path = "../../tests/common/seal.rs"]
mod seal;
pub mod seeds;
mod sequences;
mod streams;
mod transform;

use std::sync::LazyLock;

use b2p::latents::network::{Model, Shape, untrained};
use peak_alloc::PeakAlloc;

pub use codecs::{entropy, octree};
pub use files::{clouds, model, ply, splats};
pub use mutate::{Change, mutate};
pub use pictures::{backends, render};
pub use scenes::scene;
pub use sequences::sequence;
pub use streams::{chunking, deepest, header, stream};
pub use transform::transform;

/// A target's name and what it does.
pub type Target = (&'static str, fn(&[u8]));

/// All targets.
pub const TARGETS: [Target; 14] = [
    ("header", header),
    ("stream", stream),
    ("transform", transform),
    ("sequence", sequence),
    ("scene", scene),
    ("chunking", chunking),
    ("octree", octree),
    ("entropy", entropy),
    ("backends", backends),
    ("model", model),
    ("ply", ply),
    ("splats", splats),
    ("clouds", clouds),
    ("render", render),
];

#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

/// What `run` gives, which must not hold more than so many bytes beyond what was held before. For one thread at a time.
fn within<T>(bytes: usize, run: impl FnOnce() -> T) -> T {
    let before = MEMORY.current_usage();
    MEMORY.reset_peak_usage();
    let value = run();
    let held = MEMORY.peak_usage().saturating_sub(before);
    assert!(held <= bytes, "{held} bytes where {bytes} would do");
    value
}

/// Runs it, and holds it to giving back all memory: what is prepared at the first use and kept from then on, it takes
/// only once. For one thread at a time; what a test's own surroundings take meanwhile, when another test has ended,
/// they do not take again and again.
fn giving_back(run: impl Fn()) {
    let taken = || {
        let before = MEMORY.current_usage();
        run();
        MEMORY.current_usage().saturating_sub(before)
    };
    let tries = 5;
    let gives_back = (0..tries).any(|_| taken() == 0);
    assert!(gives_back, "bytes are kept each of {tries} times");
}

/// The model that streams are coded with here.
static MODEL: LazyLock<Model> = LazyLock::new(|| {
    let shape = Shape {
        learning: true,
        ..Shape::tiny()
    };
    Model::from_bytes(&untrained(&shape, 0)).expect("an untrained model loads")
});

/// The targets whose inputs are streams, to be changed by [`mutate`].
pub const STREAMS: [&str; 4] = ["header", "stream", "chunking", "transform"];

/// Has the calling thread do all work from now on: inputs are so small that handing them over takes longer than they
/// do.
pub fn alone() {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1);
    let pool = pool.use_current_thread().build_global();
    pool.expect("nothing has run before");
}

/// Whether an input is one of those, one in `n`, for which checks are made that take longer than all others: as good as
/// at random, and always the same for the same bytes.
fn one_in(n: u8, bytes: &[u8]) -> bool {
    bytes.iter().copied().fold(0, u8::wrapping_add).is_multiple_of(n)
}

/// Bytes as a source of numbers; zeros when they are used up.
struct Source<'a>(&'a [u8]);

impl<'a> Source<'a> {
    fn byte(&mut self) -> u8 {
        let (first, rest) = self.0.split_first().unwrap_or((&0, &[]));
        self.0 = rest;
        *first
    }

    /// Up to `most`, and up to `few` for seven in eight of the bytes.
    fn count(&mut self, few: u8, most: u8) -> usize {
        let byte = self.byte();
        usize::from(byte % (if byte < 224 { few } else { most } + 1))
    }

    fn u16(&mut self) -> u16 {
        u16::from_le_bytes([self.byte(), self.byte()])
    }

    fn u32(&mut self) -> u32 {
        u32::from(self.u16()) | u32::from(self.u16()) << 16
    }

    fn float(&mut self) -> f32 {
        f32::from_bits(self.u32())
    }

    fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    fn rest(self) -> &'a [u8] {
        self.0
    }
}
