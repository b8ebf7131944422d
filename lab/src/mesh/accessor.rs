//! Reads the numbers of a glTF accessor: floats, normalised integers, unsigned integers; dense or sparse.

use gltf::Accessor;
use gltf::accessor::{DataType, Dimensions};

use crate::error::Result;

/// The binary chunk of a glTF file.
#[derive(Debug, Clone, Copy)]
pub(super) struct Blob<'a>(pub &'a [u8]);

impl<'a> Blob<'a> {
    /// Items of `N` floats. Integers are read as fractions of their type's largest value where the file says so.
    ///
    /// # Errors
    /// If the accessor has another shape or type, or lies outside of the file. `name` is what the message calls it.
    pub fn floats<const N: usize>(&self, accessor: &Accessor, name: &str) -> Result<Vec<[f32; N]>, String> {
        let kind = accessor.data_type();
        if accessor.dimensions().multiplicity() != N || (kind != DataType::F32 && !accessor.normalized()) {
            return Err(format!("{name} is not {N} 32-bit floats or normalised integers"));
        }
        let width = kind.size();
        // Columns of matrices are padded to four bytes, which floats fill.
        if matches!(accessor.dimensions(), Dimensions::Mat2 | Dimensions::Mat3) && width < 4 {
            return Err(format!("{name} is a matrix of integers, which is not read"));
        }
        let values: Vec<[f32; N]> = self.items(accessor, name, |item| {
            std::array::from_fn(|i| float(&item[i * width..(i + 1) * width], kind))
        })?;
        if values.iter().flatten().any(|x| !x.is_finite()) {
            return Err(format!("a {name} is not finite"));
        }
        Ok(values)
    }

    /// Items of `N` unsigned integers.
    ///
    /// # Errors
    /// As [`Blob::floats`].
    pub fn unsigned<const N: usize>(&self, accessor: &Accessor, name: &str) -> Result<Vec<[u32; N]>, String> {
        let kind = accessor.data_type();
        let ok = matches!(kind, DataType::U8 | DataType::U16 | DataType::U32);
        if accessor.dimensions().multiplicity() != N || !ok {
            return Err(format!("{name} is not {N} unsigned integers"));
        }
        let width = kind.size();
        self.items(accessor, name, |item| {
            std::array::from_fn(|i| little_endian(&item[i * width..(i + 1) * width]))
        })
    }

    fn items<T: Copy>(&self, accessor: &Accessor, name: &str, read: impl Fn(&[u8]) -> T) -> Result<Vec<T>, String> {
        let (size, count) = (accessor.size(), accessor.count());
        let mut items: Vec<T> = match accessor.view() {
            Some(view) => {
                let stride = view.stride().unwrap_or(size);
                let start = view.offset().checked_add(accessor.offset());
                self.strided(start, size, stride, count, name)?.map(&read).collect()
            }
            None if accessor.sparse().is_some() => {
                // Zeros, as many as the file could describe: a sparse accessor is never longer than its vertices.
                if count > self.0.len() {
                    return Err(format!(
                        "{name} has {count} items without data, more than the file has bytes"
                    ));
                }
                vec![read(&vec![0; size]); count]
            }
            None => return Err(format!("{name} has no data")),
        };
        if let Some(sparse) = accessor.sparse() {
            let (indices, values) = (sparse.indices(), sparse.values());
            let width = indices.index_type().size();
            let start = indices.view().offset().checked_add(indices.offset());
            let places = self
                .strided(start, width, width, sparse.count(), name)?
                .map(little_endian);
            let start = values.view().offset().checked_add(values.offset());
            let values = self.strided(start, size, size, sparse.count(), name)?.map(&read);
            for (place, value) in places.zip(values) {
                let item = items.get_mut(place as usize);
                *item.ok_or_else(|| format!("{name} has no item {place}, which its sparse part names"))? = value;
            }
        }
        Ok(items)
    }

    /// `count` items of `size` bytes, one every `stride` bytes.
    fn strided(
        &self,
        start: Option<usize>,
        size: usize,
        stride: usize,
        count: usize,
        name: &str,
    ) -> Result<impl Iterator<Item = &'a [u8]> + use<'a>, String> {
        if stride < size {
            return Err(format!("{name} has items of {size} bytes every {stride}"));
        }
        let length = match count {
            0 => Some(0),
            n => stride.checked_mul(n - 1).and_then(|x| x.checked_add(size)),
        };
        let data = start
            .zip(length)
            .and_then(|(start, length)| Some(start..start.checked_add(length)?))
            .and_then(|range| self.0.get(range))
            .ok_or_else(|| format!("{name} lies outside of the file"))?;
        Ok((0..count).map(move |i| &data[i * stride..i * stride + size]))
    }
}

fn little_endian(bytes: &[u8]) -> u32 {
    bytes.iter().rev().fold(0, |value, &b| value << 8 | u32::from(b))
}

/// A component as glTF 2.0, 3.6.2.2, converts it.
fn float(bytes: &[u8], kind: DataType) -> f32 {
    let bits = little_endian(bytes);
    match kind {
        DataType::F32 => f32::from_bits(bits),
        DataType::U8 => bits as f32 / 255.0,
        DataType::U16 => bits as f32 / 65535.0,
        DataType::U32 => (f64::from(bits) / f64::from(u32::MAX)) as f32,
        DataType::I8 => (f32::from(bits as u8 as i8) / 127.0).max(-1.0),
        DataType::I16 => (f32::from(bits as u16 as i16) / 32767.0).max(-1.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normalised_integers_are_fractions_of_their_largest_value() {
        assert_eq!(float(&[255], DataType::U8), 1.0);
        assert_eq!(float(&[0xff, 0x7f], DataType::I16), 1.0);
        assert_eq!(float(&[0x80], DataType::I8), -1.0);
        assert_eq!(float(&1.5f32.to_le_bytes(), DataType::F32), 1.5);
    }

    #[test]
    fn items_beyond_the_end_are_refused_whatever_the_numbers() {
        let blob = Blob(&[0; 16]);
        assert!(blob.strided(Some(0), 4, 4, 4, "x").is_ok());
        assert!(blob.strided(Some(4), 4, 4, 4, "x").is_err());
        assert!(blob.strided(Some(usize::MAX), 4, 4, 1, "x").is_err());
        assert!(blob.strided(Some(0), 4, usize::MAX, 3, "x").is_err());
        assert!(blob.strided(Some(0), 4, 2, 1, "x").is_err());
        assert_eq!(blob.strided(Some(16), 4, 4, 0, "x").unwrap().count(), 0);
    }
}
