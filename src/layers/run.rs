//! Running layers and blocks over all rows of a level, in blocks of rows side by side.

use b2p_kernels::f16;
use b2p_kernels::{ExactConv, FloatConv, Isa, Output, Taps, Zeros, to_f16};
use rayon::prelude::*;

/// An Inception block: two branches side by side, and the input added.
pub(crate) struct Inception<L> {
    pub a1: L,
    pub a2: L,
    pub b1: L,
    pub b2: L,
    pub b3: L,
    pub relu: bool,
}

/// A residual block.
pub(crate) struct ResBlock<L> {
    pub c1: L,
    pub c2: L,
    pub relu: bool,
}

/// Rows that one task computes. Rows don't depend on one another, so neither do results on the number of threads.
const BLOCK: usize = 512;

/// A layer whose rows are values of one kind, in and out.
pub(crate) trait Conv: Sync {
    type Value: Zeros + Send + Sync;

    fn cout(&self) -> usize;
    fn run(&self, isa: Isa, taps: Taps<'_>, input: &[Self::Value], first: usize, output: Output<'_, Self::Value>);
    /// As `run`, without rounding.
    fn run_f32(
        &self,
        isa: Isa,
        taps: Taps<'_>,
        input: &[Self::Value],
        first: usize,
        output: Output<'_, f32, Self::Value>,
    );
}

impl Conv for ExactConv {
    type Value = i16;

    fn cout(&self) -> usize {
        self.cout()
    }

    fn run(&self, isa: Isa, taps: Taps<'_>, input: &[i16], first: usize, output: Output<'_, i16>) {
        self.run(isa, taps, input, first, output);
    }

    fn run_f32(&self, isa: Isa, taps: Taps<'_>, input: &[i16], first: usize, output: Output<'_, f32, i16>) {
        self.run_f32(isa, taps, input, first, output);
    }
}

impl Conv for FloatConv {
    type Value = f16;

    fn cout(&self) -> usize {
        self.cout()
    }

    fn run(&self, isa: Isa, taps: Taps<'_>, input: &[f16], first: usize, output: Output<'_, f16>) {
        self.run(isa, taps, input, first, output);
    }

    fn run_f32(&self, isa: Isa, taps: Taps<'_>, input: &[f16], first: usize, output: Output<'_, f32, f16>) {
        self.run(isa, taps, input, first, output);
    }
}

/// Memory of results that have been read, for the next ones: what is fresh from the system costs a fault every page
/// when it is first written.
#[derive(Debug)]
pub(crate) struct Pool<T>(Vec<Vec<T>>);

impl<T: Zeros> Pool<T> {
    pub fn new() -> Self {
        Pool(Vec::new())
    }

    /// `len` values, which may be anything.
    pub fn take(&mut self, len: usize) -> Vec<T> {
        let fitting = self.0.iter().enumerate();
        let fitting = fitting.filter(|(_, buffer)| buffer.capacity() >= len);
        match fitting.min_by_key(|(_, buffer)| buffer.capacity()) {
            Some((i, _)) => {
                let mut buffer = self.0.swap_remove(i);
                buffer.resize(len, T::default());
                buffer
            }
            None => {
                // What is too small now will be so later: levels grow.
                let sizes = self.0.iter().enumerate();
                if let Some((i, _)) = sizes.max_by_key(|(_, buffer)| buffer.capacity()) {
                    self.0.swap_remove(i);
                }
                T::zeros(len)
            }
        }
    }

    /// Gives all but some of the memory back to the system.
    pub fn keep(&mut self, buffers: usize) {
        self.0.sort_by_key(|buffer| std::cmp::Reverse(buffer.capacity()));
        self.0.truncate(buffers);
    }

    /// Takes back what nobody reads any more.
    pub fn give(&mut self, buffer: Vec<T>) {
        self.0.push(buffer);
    }
}

/// A layer's `rows` output rows.
pub(crate) fn apply<C: Conv>(
    pool: &mut Pool<C::Value>,
    isa: Isa,
    conv: &C,
    taps: Taps<'_>,
    input: &[C::Value],
    rows: usize,
    relu: bool,
) -> Vec<C::Value> {
    let mut out = pool.take(rows * conv.cout());
    let output = Output {
        rows: &mut out,
        stride: conv.cout(),
        column: 0,
        residual: None,
        relu,
    };
    spread(output, |first, output| conv.run(isa, taps, input, first, output));
    out
}

/// Makes `rows` `relu?(layer + rows)`.
pub(crate) fn apply_onto<C: Conv>(
    isa: Isa,
    conv: &C,
    taps: Taps<'_>,
    input: &[C::Value],
    rows: &mut [C::Value],
    relu: bool,
) {
    let stride = conv.cout();
    rows.par_chunks_mut(BLOCK * stride).enumerate().for_each(|(i, rows)| {
        let before = rows.to_vec();
        let output = Output {
            rows,
            stride,
            column: 0,
            residual: Some(&before[..]),
            relu,
        };
        conv.run(isa, taps, input, i * BLOCK, output);
    });
}

/// Output rows of a layer that ends in f32, from row `first` on, as many as there is room for. `first` is a multiple of
/// 512.
pub(crate) fn apply_part<C: Conv>(
    isa: Isa,
    conv: &C,
    taps: Taps<'_>,
    input: &[C::Value],
    first: usize,
    out: &mut [f32],
) {
    debug_assert!(first.is_multiple_of(BLOCK));
    let output = Output {
        rows: out,
        stride: conv.cout(),
        column: 0,
        residual: None,
        relu: false,
    };
    spread(output, |row, output| {
        conv.run_f32(isa, taps, input, first + row, output)
    });
}

/// Output rows of a layer that ends in f32, as many as there is room for.
pub(crate) fn apply_f32<C: Conv>(isa: Isa, conv: &C, taps: Taps<'_>, input: &[C::Value], out: &mut [f32]) {
    apply_part(isa, conv, taps, input, 0, out);
}

/// Calls `run(first row, part)` for parts of the output, in parallel.
fn spread<T: Send, R: Sync>(output: Output<'_, T, R>, run: impl Fn(usize, Output<'_, T, R>) + Sync) {
    let Output {
        rows,
        stride,
        column,
        residual,
        relu,
    } = output;
    rows.par_chunks_mut(BLOCK * stride).enumerate().for_each(|(i, rows)| {
        let residual = residual.map(|all| &all[i * BLOCK * stride..][..rows.len()]);
        run(
            i * BLOCK,
            Output {
                rows,
                stride,
                column,
                residual,
                relu,
            },
        );
    });
}

impl<C: Conv> Inception<C> {
    /// `relu?(concat[a2(relu(a1(x))), b3(relu(b2(relu(b1(x)))))] + x)`, activations of both branches in ReLU.
    pub fn apply(&self, pool: &mut Pool<C::Value>, isa: Isa, map: Taps<'_>, x: Vec<C::Value>) -> Vec<C::Value> {
        let (left, right) = (self.a2.cout(), self.b3.cout());
        let stride = left + right;
        let rows = x.len() / stride;
        let mut out = pool.take(x.len());
        let mut branch = |conv: &C, taps: Taps<'_>, input: &[C::Value], column: usize| {
            let output = Output {
                rows: &mut out[..],
                stride,
                column,
                residual: Some(&x[..]),
                relu: self.relu,
            };
            spread(output, |first, output| conv.run(isa, taps, input, first, output));
        };
        let a = apply(pool, isa, &self.a1, map, &x, rows, true);
        branch(&self.a2, map, &a, 0);
        pool.give(a);
        let b1 = apply(pool, isa, &self.b1, Taps::Same, &x, rows, true);
        let b2 = apply(pool, isa, &self.b2, map, &b1, rows, true);
        branch(&self.b3, Taps::Same, &b2, left);
        for read in [b1, b2, x] {
            pool.give(read);
        }
        out
    }
}

impl<C: Conv> ResBlock<C> {
    /// `relu?(c2(relu(c1(x))) + x)`.
    pub fn apply(&self, pool: &mut Pool<C::Value>, isa: Isa, map: Taps<'_>, x: Vec<C::Value>) -> Vec<C::Value> {
        let rows = x.len() / self.c2.cout();
        self.apply_to_some(pool, isa, map, x, [rows, rows])
    }

    /// As `apply`, but the inner layer computes its first `rows[0]` rows only, the others being zero, and the outer one
    /// as many as are asked for, the first `rows[1]`.
    pub fn apply_to_some(
        &self,
        pool: &mut Pool<C::Value>,
        isa: Isa,
        map: Taps<'_>,
        mut x: Vec<C::Value>,
        rows: [usize; 2],
    ) -> Vec<C::Value> {
        let stride = self.c2.cout();
        let mut inner = pool.take(x.len());
        let (some, others) = inner.split_at_mut(rows[0] * stride);
        others.fill(C::Value::default());
        let output = Output {
            rows: some,
            stride,
            column: 0,
            residual: None,
            relu: true,
        };
        spread(output, |first, output| self.c1.run(isa, map, &x, first, output));
        x.truncate(rows[1] * stride);
        apply_onto(isa, &self.c2, map, &inner, &mut x, self.relu);
        pool.give(inner);
        x
    }
}

/// Rows of `left` and `right`, of `a` and `b` values, side by side.
pub(crate) fn concat<T: Zeros + Send + Sync>(
    pool: &mut Pool<T>,
    left: &[T],
    a: usize,
    right: &[T],
    b: usize,
) -> Vec<T> {
    let mut out = pool.take(left.len() + right.len());
    let rows = out.par_chunks_mut((a + b) * BLOCK);
    let parts = left.par_chunks(a * BLOCK).zip(right.par_chunks(b * BLOCK));
    rows.zip(parts).for_each(|(rows, (left, right))| {
        let parts = left.chunks_exact(a).zip(right.chunks_exact(b));
        for (row, (left, right)) in rows.chunks_exact_mut(a + b).zip(parts) {
            row[..a].copy_from_slice(left);
            row[a..].copy_from_slice(right);
        }
    });
    out
}

/// The real numbers that integer activations stand for.
pub(crate) fn reals(isa: Isa, q: &[i16], scale: f32) -> Vec<f16> {
    const CHUNK: usize = 4096;
    let mut out = f16::zeros(q.len());
    out.par_chunks_mut(CHUNK).zip(q.par_chunks(CHUNK)).for_each(|(out, q)| {
        let real: Vec<f32> = q.iter().map(|&q| f32::from(q) * scale).collect();
        to_f16(isa, &real, out);
    });
    out
}
