//! What is to be judged, from the command line and from files.

use std::io::Read;
use std::path::{Path, PathBuf};

use b2p::Limits;
use b2p::cloud::PointCloud;
use b2p::cloud::ply::Ply;
use b2p::container::MAGIC;
use b2p::gaussians::Gaussians;

use crate::error::{LabError, Result};

/// Something to judge: `[NAME=]PATH[@BPP]`.
#[derive(Debug, Clone, PartialEq)]
pub struct Item {
    /// What tables call it: NAME, or the file's name without its ending.
    pub name: String,
    /// The file.
    pub path: PathBuf,
    /// Its rate in bits per point of the finest cloud, if the file cannot tell.
    pub bpp: Option<f64>,
}

impl std::str::FromStr for Item {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (name, rest) = match text.split_once('=') {
            Some((name, rest)) if !name.contains('/') => (Some(name), rest),
            _ => (None, text),
        };
        let (path, bpp) = match rest.rsplit_once('@') {
            Some((path, number)) if !number.contains('/') => {
                let bpp: f64 = number
                    .parse()
                    .map_err(|_| format!("'{number}' after @ is no rate such as 0.41"))?;
                if !(bpp.is_finite() && bpp >= 0.0) {
                    return Err(format!("a rate is not negative, {number} is no rate"));
                }
                (path, Some(bpp))
            }
            _ => (rest, None),
        };
        if path.is_empty() {
            return Err("expected [NAME=]PATH[@BPP]".into());
        }
        let path = PathBuf::from(path);
        let name = name.map_or_else(|| stem(&path), str::to_owned);
        Ok(Item { name, path, bpp })
    }
}

/// The file's name without `.zst` and the ending before it.
fn stem(path: &Path) -> String {
    let name = path.file_name().unwrap_or(path.as_os_str());
    let name = name.to_string_lossy();
    let plain = name.strip_suffix(".zst").unwrap_or(&name);
    match plain.rsplit_once('.') {
        Some((stem, ending)) if !stem.is_empty() && ["ply", "b2p"].contains(&ending) => stem.into(),
        _ => plain.into(),
    }
}

/// A file's bytes, unpacked if it is compressed with zstd.
///
/// # Errors
/// If it cannot be read or unpacked, or holds more than the limits allow.
pub fn read(path: &Path, limits: &Limits) -> Result<Vec<u8>> {
    let bytes = std::fs::read(path).map_err(LabError::io(path))?;
    if !bytes.starts_with(&[0x28, 0xb5, 0x2f, 0xfd]) {
        return Ok(bytes);
    }
    let damaged = |error: &dyn std::fmt::Display| LabError::Usage(format!("{}: zstd: {error}", path.display()));
    let unpacker = ruzstd::decoding::StreamingDecoder::new(bytes.as_slice()).map_err(|e| damaged(&e))?;
    let mut plain = Vec::new();
    unpacker
        .take(limits.max_bytes + 1)
        .read_to_end(&mut plain)
        .map_err(|e| damaged(&e))?;
    limits.check_bytes("bytes of the unpacked file", plain.len() as u64)?;
    Ok(plain)
}

/// What an item's file holds.
#[derive(Debug, Clone)]
pub enum Content {
    /// Points on the voxel grid.
    Cloud(PointCloud),
    /// Gaussians.
    Gaussians(Gaussians),
    /// A `.b2p` stream.
    Stream(Vec<u8>),
}

/// A stream, a point cloud's file, or one of Gaussians, compressed or not.
///
/// # Errors
/// As [`read`], or if it is none of them.
pub fn open(path: &Path, limits: &Limits) -> Result<Content> {
    let bytes = read(path, limits)?;
    if bytes.starts_with(&MAGIC) {
        return Ok(Content::Stream(bytes));
    }
    let ply = Ply::open(&bytes)?;
    let splats = ply.element("vertex").is_some_and(|v| v.has("f_dc_0"));
    Ok(if splats {
        Content::Gaussians(Gaussians::from_ply(&bytes, limits)?)
    } else {
        Content::Cloud(PointCloud::from_ply(&bytes, limits)?)
    })
}

/// A point cloud's file, compressed or not.
///
/// # Errors
/// As [`read`], or if it is no cloud.
pub fn read_cloud(path: &Path, limits: &Limits) -> Result<PointCloud> {
    Ok(PointCloud::from_ply(&read(path, limits)?, limits)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn item(text: &str) -> Item {
        text.parse().unwrap()
    }

    #[test]
    fn name_and_rate_are_optional() {
        let plain = item("clouds/a.ply.zst");
        assert_eq!((plain.name.as_str(), plain.bpp), ("a", None));
        let whole = item("G-PCC=clouds/a.ply@0.41");
        assert_eq!(whole.name, "G-PCC");
        assert_eq!(whole.path, Path::new("clouds/a.ply"));
        assert_eq!(whole.bpp, Some(0.41));
        assert_eq!(item("x.b2p").name, "x");
        assert_eq!(item("a_s0.5_q34.ply.zst").name, "a_s0.5_q34");
    }

    #[test]
    fn folders_may_hold_signs() {
        let odd = item("a=b@c/d=e.ply");
        assert_eq!(odd.name, "a");
        assert_eq!(odd.path, Path::new("b@c/d=e.ply"));
        assert_eq!(item("x/a=b/c.ply").path, Path::new("x/a=b/c.ply"));
    }

    #[test]
    fn a_rate_must_be_a_number() {
        assert!("a.ply@fast".parse::<Item>().unwrap_err().contains("0.41"));
        assert!("a.ply@-1".parse::<Item>().is_err());
        assert!("a.ply@NaN".parse::<Item>().is_err());
        assert!("name=".parse::<Item>().is_err());
    }

    #[test]
    fn a_compressed_file_is_unpacked_and_a_bomb_refused() {
        // "hello hello hello" as one raw zstd block, without checksum.
        let text = b"hello hello hello";
        let mut packed = vec![0x28, 0xb5, 0x2f, 0xfd, 0x20, text.len() as u8];
        packed.extend([(text.len() << 3) as u8 | 1, 0, 0]);
        packed.extend(text);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.ply.zst");
        std::fs::write(&path, &packed).unwrap();
        assert_eq!(read(&path, &Limits::default()).unwrap(), text);
        let tight = Limits::default().with_max_bytes(10);
        let refusal = read(&path, &tight).unwrap_err().to_string();
        assert!(refusal.contains("max_bytes"), "{refusal}");
        std::fs::write(&path, &packed[..12]).unwrap();
        assert!(read(&path, &Limits::default()).is_err());
    }

    #[test]
    fn a_ply_of_gaussians_is_distinguished_from_one_of_points() {
        let folder = tempfile::tempdir().unwrap();
        let limits = Limits::default();
        let points = PointCloud {
            positions: vec![[1.0, 2.0, 3.0]],
            colours: vec![[9; 3]],
            ..PointCloud::default()
        };
        let path = folder.path().join("points.ply");
        points.write(&path).unwrap();
        assert!(matches!(open(&path, &limits).unwrap(), Content::Cloud(c) if c == points));

        let mut file = Vec::new();
        let path = folder.path().join("splats.ply");
        Gaussians::default().write_ply(&mut file, &path).unwrap();
        std::fs::write(&path, file).unwrap();
        assert!(matches!(open(&path, &limits).unwrap(), Content::Gaussians(_)));
    }
}
