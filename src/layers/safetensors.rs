//! The safetensors container: the length of a table of contents in eight bytes, the table in JSON, then the tensors end
//! to end. See <https://github.com/huggingface/safetensors>.

use std::collections::BTreeMap;
use std::ops::Range;

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result, Stage};

/// Bytes of the table's length.
const LENGTH: usize = size_of::<u64>();

/// What a tensor's entries are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "UPPERCASE")]
pub(crate) enum Dtype {
    Bool,
    U8,
    I8,
    U16,
    I16,
    F16,
    Bf16,
    U32,
    I32,
    F32,
    U64,
    I64,
    F64,
}

impl Dtype {
    /// Bytes of an entry.
    pub fn size(self) -> usize {
        match self {
            Dtype::Bool | Dtype::U8 | Dtype::I8 => 1,
            Dtype::U16 | Dtype::I16 | Dtype::F16 | Dtype::Bf16 => 2,
            Dtype::U32 | Dtype::I32 | Dtype::F32 => 4,
            Dtype::U64 | Dtype::I64 | Dtype::F64 => 8,
        }
    }
}

/// A tensor as the table has it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Info {
    pub dtype: Dtype,
    pub shape: Vec<usize>,
    data_offsets: (usize, usize),
}

impl Info {
    /// Where its bytes lie, counted from the end of the table.
    pub fn range(&self) -> Range<usize> {
        self.data_offsets.0..self.data_offsets.1
    }

    /// Its bytes by type and extents.
    fn size(&self) -> Option<usize> {
        let mut extents = self.shape.iter();
        extents.try_fold(self.dtype.size(), |size, &n| size.checked_mul(n))
    }
}

/// A table of contents.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Contents {
    /// Texts by their names.
    #[serde(rename = "__metadata__", default)]
    pub metadata: BTreeMap<String, String>,
    /// Tensors by their names.
    #[serde(flatten)]
    pub tensors: BTreeMap<String, Info>,
}

impl Contents {
    /// The table of a file, and the bytes behind it, which its tensors fill without gaps.
    ///
    /// # Errors
    /// [`Error::Malformed`] if it is no such file.
    pub fn read(file: &[u8]) -> Result<(Contents, &[u8])> {
        let Some((length, rest)) = file.split_first_chunk::<LENGTH>() else {
            return Err(malformed(0, "length", file.len(), "8 bytes or more"));
        };
        let length = u64::from_le_bytes(*length);
        let table = usize::try_from(length).ok();
        let Some((table, data)) = table.and_then(|length| rest.split_at_checked(length)) else {
            let expected = format!("at most {}", rest.len());
            return Err(malformed(0, "length of the header", length, expected));
        };
        let contents: Contents = serde_json::from_slice(table)
            .map_err(|error| malformed(LENGTH, "header", error, "a safetensors header"))?;
        contents.check(data.len())?;
        Ok((contents, data))
    }

    /// Fails unless the tensors lie end to end in `length` bytes, each in as many as it has.
    fn check(&self, length: usize) -> Result<()> {
        let mut tensors: Vec<_> = self.tensors.iter().collect();
        tensors.sort_by_key(|(_, info)| info.data_offsets);
        let mut end = 0usize;
        for (name, info) in tensors {
            let found = info.data_offsets;
            let next = info.size().and_then(|size| end.checked_add(size));
            if next.is_none_or(|next| found != (end, next)) {
                let expected = match next {
                    Some(next) => format!("({end}, {next})"),
                    None => "a size that memory can hold".into(),
                };
                let field = format!("data_offsets of tensor {name}");
                return Err(malformed(LENGTH, field, format!("{found:?}"), expected));
            }
            end = found.1;
        }
        match end == length {
            true => Ok(()),
            false => Err(malformed(LENGTH, "bytes of tensors", length, end)),
        }
    }
}

fn malformed(at: usize, field: impl ToString, value: impl ToString, expected: impl ToString) -> Error {
    let at = format!("byte {at} of the model file");
    Error::malformed(Stage::Network, at, field, value, expected)
}

/// A file that is being put together.
#[derive(Debug, Default)]
pub(crate) struct File {
    contents: Contents,
    data: Vec<u8>,
}

impl File {
    /// Without tensors.
    pub fn new(metadata: BTreeMap<String, String>) -> File {
        let tensors = BTreeMap::new();
        let contents = Contents { metadata, tensors };
        File {
            contents,
            data: Vec::new(),
        }
    }

    /// Adds a tensor.
    ///
    /// # Panics
    /// If the bytes are not as many as it has.
    pub fn add(&mut self, name: &str, dtype: Dtype, shape: &[usize], bytes: &[u8]) {
        let start = self.data.len();
        self.data.extend(bytes);
        let info = Info {
            dtype,
            shape: shape.to_vec(),
            data_offsets: (start, self.data.len()),
        };
        assert_eq!(info.size(), Some(bytes.len()), "{name}");
        self.contents.tensors.insert(name.to_owned(), info);
    }

    /// Its bytes.
    pub fn write(&self) -> Vec<u8> {
        let mut table = serde_json::to_vec(&self.contents).expect("a table's keys are strings");
        // Tensors start at a multiple of eight bytes.
        table.resize(table.len().next_multiple_of(LENGTH), b' ');
        let length = table.len() as u64;
        [&length.to_le_bytes()[..], &table, &self.data].concat()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use safetensors::SafeTensors;

    fn file() -> File {
        let mut file = File::new([("name".to_owned(), "\"quoted\" µ".to_owned())].into());
        file.add("b", Dtype::F16, &[2, 3], &[1; 12]);
        file.add("a", Dtype::U8, &[], &[7]);
        file.add("nothing", Dtype::I32, &[4, 0], &[]);
        file.add("c", Dtype::F32, &[2], &[9; 8]);
        file
    }

    fn with_header(json: &str, data: usize) -> Vec<u8> {
        let length = json.len() as u64;
        [&length.to_le_bytes()[..], json.as_bytes(), &vec![0; data]].concat()
    }

    #[test]
    fn what_was_written_is_read_here_and_by_the_reference() {
        let file = file();
        let bytes = file.write();
        let (contents, data) = Contents::read(&bytes).unwrap();
        assert_eq!((&contents, data), (&file.contents, &file.data[..]));
        let theirs = SafeTensors::deserialize(&bytes).unwrap();
        assert_eq!(theirs.len(), contents.tensors.len());
        for (name, info) in &contents.tensors {
            let tensor = theirs.tensor(name).unwrap();
            let named = format!("{:?}", info.dtype);
            assert_eq!(format!("{:?}", tensor.dtype()), named);
            assert_eq!(tensor.shape(), info.shape);
            assert_eq!(tensor.data(), &data[info.range()]);
        }
    }

    #[test]
    fn every_cut_and_every_changed_bit_is_judged_as_the_reference_judges_it() {
        let bytes = file().write();
        let mut refused = 0;
        let mut judge = |bytes: &[u8]| {
            let (ours, theirs) = (Contents::read(bytes), SafeTensors::deserialize(bytes));
            refused += usize::from(ours.is_err());
            assert_eq!(ours.is_ok(), theirs.is_ok(), "{:?}", bytes.get(8..));
        };
        (0..bytes.len()).for_each(|end| judge(&bytes[..end]));
        judge(&[&bytes[..], &[0]].concat());
        for bit in 0..8 * bytes.len() {
            let mut changed = bytes.clone();
            changed[bit / 8] ^= 1 << (bit % 8);
            judge(&changed);
        }
        assert!(refused > bytes.len());
    }

    #[test]
    fn a_table_that_lies_is_refused_with_the_place() {
        let one = |dtype: &str, shape: &str, offsets: &str| {
            format!(r#"{{"a":{{"dtype":"{dtype}","shape":{shape},"data_offsets":{offsets}}}}}"#)
        };
        let huge = u64::MAX;
        for (json, data, text) in [
            (one("U8", "[4]", "[0,4]"), 3, "bytes of tensors is 3, expected 4"),
            (one("U8", "[4]", "[0,4]"), 5, "bytes of tensors is 5, expected 4"),
            (
                one("U8", "[4]", "[1,5]"),
                5,
                "data_offsets of tensor a is (1, 5), expected (0, 4)",
            ),
            (one("U16", "[4]", "[0,4]"), 4, "expected (0, 8)"),
            (one("U8", "[4]", "[4,0]"), 4, "expected (0, 4)"),
            (one("U8", "[4294967296,4294967296]", "[0,0]"), 0, "memory can hold"),
            (one("U8", &format!("[{huge}]"), &format!("[0,{huge}]")), 0, "tensor"),
            (one("X9", "[]", "[0,1]"), 1, "X9"),
            (one("U8", "[-1]", "[0,1]"), 1, "header"),
            ("[]".into(), 0, "header"),
            (String::new(), 0, "header"),
            ("[".repeat(100_000), 0, "header"),
        ] {
            let bytes = with_header(&json, data);
            let error = Contents::read(&bytes).unwrap_err();
            assert!(matches!(error, Error::Malformed { .. }), "{json}");
            let error = error.to_string();
            assert!(error.contains(text), "{error}");
            assert!(SafeTensors::deserialize(&bytes).is_err(), "{json}");
        }
        for bytes in [&[][..], &[1; 7], &[255; 8], &[1, 0, 0, 0, 0, 0, 0, 0]] {
            assert!(Contents::read(bytes).is_err());
        }
    }
}
