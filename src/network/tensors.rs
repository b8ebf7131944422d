//! Tensors of a model file, each checked before it becomes a layer.

use b2p_kernels::{ExactConv, FloatConv, LIMIT, Requantise, Scale};
use half::f16;
use safetensors::{Dtype, SafeTensors};

use crate::error::{Error, Result, Stage};

/// The largest magnitude of an exact weight.
const WEIGHT_LIMIT: i16 = 511;
/// The largest shift that leaves a bit of a sum.
const SHIFT_LIMIT: u8 = 30;

/// The tensors of a file.
pub(super) struct Tensors<'a> {
    file: SafeTensors<'a>,
}

impl<'a> Tensors<'a> {
    pub fn new(file: SafeTensors<'a>) -> Self {
        Tensors { file }
    }

    /// Whether there is a tensor of that name.
    pub fn has(&self, name: &str) -> bool {
        self.file.tensor(name).is_ok()
    }

    /// Tensors whose names start so, in the order of their names: name, type, shape, bytes.
    pub fn with_prefixes(&self, prefixes: &[&str]) -> Vec<(String, String, Vec<usize>, &'a [u8])> {
        let mut found: Vec<_> = self
            .file
            .iter()
            .filter(|(name, _)| prefixes.iter().any(|p| name.starts_with(p)))
            .map(|(name, view)| {
                let kind = format!("{:?}", view.dtype());
                (name.to_owned(), kind, view.shape().to_vec(), view.data())
            })
            .collect();
        found.sort_by(|a, b| a.0.cmp(&b.0));
        found
    }

    /// A tensor's values; `shape` entries of `None` may be anything.
    pub fn values<T: Element>(&self, name: &str, shape: &[Option<usize>]) -> Result<Vec<T>> {
        let view = self
            .file
            .tensor(name)
            .map_err(|_| wrong(name, "the tensor", "missing", "present"))?;
        if view.dtype() != T::DTYPE {
            let found = format!("{:?}", view.dtype());
            return Err(wrong(name, "type", found, format!("{:?}", T::DTYPE)));
        }
        let fits = view.shape().len() == shape.len()
            && view
                .shape()
                .iter()
                .zip(shape)
                .all(|(have, want)| want.is_none_or(|w| w == *have));
        if !fits {
            let expected: Vec<_> = shape
                .iter()
                .map(|n| n.map_or("any".to_owned(), |n| n.to_string()))
                .collect();
            let expected = format!("[{}]", expected.join(", "));
            return Err(wrong(
                name,
                "shape",
                format!("{:?}", view.shape()),
                expected,
            ));
        }
        Ok(view
            .data()
            .chunks_exact(size_of::<T>())
            .map(T::read)
            .collect())
    }

    /// Floats that must all be finite.
    fn finite(&self, name: &str, count: usize) -> Result<Vec<f32>> {
        let values = self.values::<f32>(name, &[Some(count)])?;
        match values.iter().position(|v| !v.is_finite()) {
            Some(i) => Err(wrong(
                name,
                format!("entry {i}"),
                values[i],
                "a finite number",
            )),
            None => Ok(values),
        }
    }

    /// The scales of a per-role tensor: finite and positive.
    pub fn scales(&self, name: &str, count: usize) -> Result<Vec<f32>> {
        let values = self.finite(name, count)?;
        match values.iter().position(|v| *v <= 0.0) {
            Some(i) => Err(wrong(
                name,
                format!("entry {i}"),
                values[i],
                "a positive number",
            )),
            None => Ok(values),
        }
    }

    /// An exact layer that requantises by shifting. Proves that no sum leaves 32 bits.
    pub fn shifted(&self, name: &str, volume: usize, cin: usize, cout: usize) -> Result<ExactConv> {
        let weights = self.exact_weights(name, volume, cin, cout)?;
        let bias = self.values::<i32>(&format!("{name}.bias"), &[Some(cout)])?;
        let shift = self.values::<u8>(&format!("{name}.shift"), &[Some(cout)])?;
        if let Some(o) = shift.iter().position(|&s| s > SHIFT_LIMIT) {
            let at = format!("{name}.shift");
            return Err(wrong(&at, format!("entry {o}"), shift[o], "0 to 30"));
        }
        prove_sums(name, &weights, cout, |o| i64::from(bias[o]).abs())?;
        Ok(ExactConv::new(
            volume,
            cin,
            cout,
            &weights,
            Requantise::Shift { bias, shift },
        ))
    }

    /// An exact geometry-invariant layer. Proves that neither sums nor squared norms leave 32 bits.
    pub fn invariant(
        &self,
        name: &str,
        volume: usize,
        cin: usize,
        cout: usize,
    ) -> Result<ExactConv> {
        let weights = self.exact_weights(name, volume, cin, cout)?;
        let gain = self.finite(&format!("{name}.gain"), cout)?;
        let bias = self.finite(&format!("{name}.bias"), cout)?;
        prove_sums(name, &weights, cout, |_| 0)?;
        for o in 0..cout {
            let energy: i64 = weights
                .iter()
                .skip(o)
                .step_by(cout)
                .map(|&w| i64::from(w).pow(2))
                .sum();
            if energy >= 1 << 31 {
                let field = format!("squared norm of output channel {o}");
                return Err(wrong(name, field, energy, "less than 2^31"));
            }
        }
        Ok(ExactConv::new(
            volume,
            cin,
            cout,
            &weights,
            Requantise::Invariant { gain, bias },
        ))
    }

    fn exact_weights(
        &self,
        name: &str,
        volume: usize,
        cin: usize,
        cout: usize,
    ) -> Result<Vec<i16>> {
        let at = format!("{name}.weight");
        let weights = self.values::<i16>(&at, &[Some(volume), Some(cin), Some(cout)])?;
        match weights
            .iter()
            .position(|w| w.unsigned_abs() > WEIGHT_LIMIT.unsigned_abs())
        {
            Some(i) => Err(wrong(&at, format!("entry {i}"), weights[i], "−511 to 511")),
            None => Ok(weights),
        }
    }

    /// A float layer without a norm.
    pub fn plain(&self, name: &str, volume: usize, cin: usize, cout: usize) -> Result<FloatConv> {
        self.float(name, volume, cin, cout, Scale::Plain)
    }

    /// A float geometry-invariant layer.
    pub fn normed(&self, name: &str, volume: usize, cin: usize, cout: usize) -> Result<FloatConv> {
        let gain = self.finite(&format!("{name}.gain"), cout)?;
        self.float(name, volume, cin, cout, Scale::Invariant(gain))
    }

    fn float(
        &self,
        name: &str,
        volume: usize,
        cin: usize,
        cout: usize,
        scale: Scale,
    ) -> Result<FloatConv> {
        let at = format!("{name}.weight");
        let weights = self.values::<f16>(&at, &[Some(volume), Some(cin), Some(cout)])?;
        if let Some(i) = weights.iter().position(|w| !w.is_finite()) {
            return Err(wrong(
                &at,
                format!("entry {i}"),
                weights[i],
                "a finite number",
            ));
        }
        let bias = self.finite(&format!("{name}.bias"), cout)?;
        Ok(FloatConv::new(volume, cin, cout, &weights, bias, scale))
    }
}

/// A number as safetensors files hold it.
pub(super) trait Element {
    const DTYPE: Dtype;
    /// From exactly as many little-endian bytes as the number has.
    fn read(bytes: &[u8]) -> Self;
}

macro_rules! elements {
    ($($number:ty: $dtype:ident,)*) => {$(
        impl Element for $number {
            const DTYPE: Dtype = Dtype::$dtype;
            fn read(bytes: &[u8]) -> Self {
                let mut array = [0; size_of::<$number>()];
                array.copy_from_slice(bytes);
                <$number>::from_le_bytes(array)
            }
        }
    )*};
}

elements!(u8: U8, i16: I16, u16: U16, i32: I32, u32: U32, f16: F16, f32: F32,);

/// Fails unless `Σ|w|·2047 + extra` stays below 2^31 in every output channel.
fn prove_sums(
    name: &str,
    weights: &[i16],
    cout: usize,
    extra: impl Fn(usize) -> i64,
) -> Result<()> {
    let mut sums = vec![0i64; cout];
    for row in weights.chunks_exact(cout) {
        for (sum, w) in sums.iter_mut().zip(row) {
            *sum += i64::from(*w).abs();
        }
    }
    for (o, sum) in sums.iter().enumerate() {
        let worst = sum * i64::from(LIMIT) + extra(o);
        if worst >= 1 << 31 {
            let field = format!("largest sum of output channel {o}");
            return Err(wrong(name, field, worst, "less than 2^31"));
        }
    }
    Ok(())
}

pub(super) fn wrong(
    tensor: &str,
    field: impl ToString,
    value: impl ToString,
    expected: impl ToString,
) -> Error {
    Error::malformed(
        Stage::Network,
        format!("tensor {tensor}"),
        field,
        value,
        expected,
    )
}
