//! The tensors of a model file, each checked for its type and shape before it is used.

use b2p_kernels::f16;

use super::safetensors::{Contents, Dtype, Info};
use crate::error::{Error, Result, Stage};

/// A type of tensor entries.
pub(crate) trait Element: Sized {
    const DTYPE: Dtype;
    /// Reads an entry from as many bytes as it has.
    fn read(bytes: &[u8]) -> Self;
}

macro_rules! element {
    ($($ty:ty: $dtype:ident),*) => {$(
        impl Element for $ty {
            const DTYPE: Dtype = Dtype::$dtype;
            fn read(bytes: &[u8]) -> Self {
                <$ty>::from_le_bytes(bytes.try_into().expect("chunks have the entry's size"))
            }
        }
    )*};
}
element!(u8: U8, i16: I16, u16: U16, i32: I32, u32: U32, f16: F16, f32: F32);

/// The tensors of a model file.
pub(crate) struct Tensors<'a> {
    contents: Contents,
    data: &'a [u8],
}

impl<'a> Tensors<'a> {
    /// Reads the file's table of contents.
    ///
    /// # Errors
    /// Those of [`Contents::read`].
    pub fn new(bytes: &'a [u8]) -> Result<Self> {
        let (contents, data) = Contents::read(bytes)?;
        Ok(Tensors { contents, data })
    }

    /// A text of the metadata.
    pub fn metadata(&self, key: &str) -> Option<&str> {
        self.contents.metadata.get(key).map(String::as_str)
    }

    /// Whether a tensor's name starts like that.
    pub fn any(&self, prefix: &str) -> bool {
        let mut names = self.contents.tensors.keys();
        names.any(|name| name.starts_with(prefix))
    }

    /// Whether there is a tensor of that name.
    pub fn has(&self, name: &str) -> bool {
        self.contents.tensors.contains_key(name)
    }

    /// All tensors, in the order of their names, each with its bytes.
    pub fn entries(&self) -> impl Iterator<Item = (&String, &Info, &'a [u8])> {
        let data = self.data;
        let tensors = self.contents.tensors.iter();
        tensors.map(move |(name, info)| (name, info, &data[info.range()]))
    }

    /// The entries of a tensor of that very shape.
    ///
    /// # Errors
    /// [`Error::Malformed`] if there is no such tensor, or it is of another type or shape.
    pub fn get<T: Element>(&self, name: &str, shape: &[usize]) -> Result<Vec<T>> {
        let entries = self.find::<T>(name)?;
        let found = self.contents.tensors.get(name);
        let found = found.map_or(&[][..], |info| &info.shape);
        if found != shape {
            return Err(malformed(name, "shape", format!("{found:?}"), format!("{shape:?}")));
        }
        Ok(entries.map(T::read).collect())
    }

    /// The entries of a tensor of one dimension, however long.
    ///
    /// # Errors
    /// [`Error::Malformed`] if there is no such tensor, or it is of another type.
    pub fn list<T: Element>(&self, name: &str) -> Result<Vec<T>> {
        let entries = self.find::<T>(name)?;
        Ok(entries.map(T::read).collect())
    }

    fn find<T: Element>(&self, name: &str) -> Result<std::slice::ChunksExact<'a, u8>> {
        let info = self
            .contents
            .tensors
            .get(name)
            .ok_or_else(|| malformed(name, "tensor", "missing", "there"))?;
        if info.dtype != T::DTYPE {
            return Err(malformed(
                name,
                "type",
                format!("{:?}", info.dtype),
                format!("{:?}", T::DTYPE),
            ));
        }
        Ok(self.data[info.range()].chunks_exact(size_of::<T>()))
    }

    /// `count` numbers within ±`limit`.
    ///
    /// # Errors
    /// As [`Tensors::get`], and [`Error::Malformed`] for a number beyond.
    pub fn finite(&self, name: &str, count: usize, limit: f32) -> Result<Vec<f32>> {
        let values: Vec<f32> = self.get(name, &[count])?;
        match values.iter().find(|v| !v.is_finite() || v.abs() > limit) {
            Some(v) => Err(malformed(name, "entry", v, format!("within ±{limit}"))),
            None => Ok(values),
        }
    }
}

/// An error that names a tensor.
pub(crate) fn malformed(name: &str, field: &str, value: impl ToString, expected: impl ToString) -> Error {
    Error::malformed(Stage::Network, format!("tensor {name}"), field, value, expected)
}

/// The error of a model that has no such part.
pub(crate) fn missing(what: &'static str, detail: String) -> Error {
    Error::Unsupported { what, detail }
}
