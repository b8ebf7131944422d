//! What a file is, by its content.

use std::fmt;
use std::io::Read;

/// Bytes from the start of a file that are enough to recognise any kind.
pub const ENOUGH: usize = 4096;

/// Bytes of a header in text that are searched, if they are there.
const LONGEST_HEADER: usize = 1 << 20;

/// A kind of file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
#[allow(missing_docs)]
pub enum Kind {
    /// A stream of `b2p`.
    Stream,
    /// A PLY file of points, or of anything but Gaussians.
    Ply,
    /// A PLY file of Gaussians.
    GaussianPly,
    /// A PLY file of Gaussians in packed chunks (PlayCanvas).
    CompressedPly,
    /// LAS, or LAZ: the header says which.
    Las,
    Pcd,
    E57,
    /// Rows of numbers: XYZ, CSV, PTS.
    Text,
    Obj,
    /// Binary glTF.
    Glb,
    /// glTF in JSON.
    Gltf,
    /// SPZ, of any version.
    Spz,
    /// SOG, a ZIP archive.
    Sog,
    /// The metadata of an unbundled SOG.
    SogMeta,
    /// Antimatter15's 32 bytes per Gaussian. It has no magic: records are checked for plausible values.
    Splat,
    Ksplat,
    Stl,
    Fbx,
    Off,
    Png,
    Jpeg,
    WebP,
    Exr,
    Ppm,
    Gif,
    Tiff,
    Zip,
    Gzip,
    Zstd,
    Xz,
    SevenZip,
    Npz,
    Npy,
    Hdf5,
    Pdf,
    Html,
    Json,
    Empty,
    Unknown,
}

/// What a kind is a kind of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[allow(missing_docs)]
pub enum Group {
    Stream,
    Cloud,
    Splats,
    Mesh,
    Picture,
    Archive,
    Other,
}

/// Kinds with a magic at the start.
const MAGICS: [(&[u8], Kind); 25] = [
    (&b2p::container::MAGIC, Kind::Stream),
    (b"LASF", Kind::Las),
    (b"ASTM-E57", Kind::E57),
    (b"glTF", Kind::Glb),
    (b"NGSP", Kind::Spz),
    (b"Kaydara FBX", Kind::Fbx),
    (b"solid ", Kind::Stl),
    (b"OFF", Kind::Off),
    (b"COFF", Kind::Off),
    (b"\x89PNG\r\n\x1a\n", Kind::Png),
    (b"\xff\xd8\xff", Kind::Jpeg),
    (b"\x76\x2f\x31\x01", Kind::Exr),
    (b"P6", Kind::Ppm),
    (b"P3", Kind::Ppm),
    (b"GIF8", Kind::Gif),
    (b"II*\0", Kind::Tiff),
    (b"MM\0*", Kind::Tiff),
    (b"\x28\xb5\x2f\xfd", Kind::Zstd),
    (b"\xfd7zXZ\0", Kind::Xz),
    (b"7z\xbc\xaf\x27\x1c", Kind::SevenZip),
    (b"\x93NUMPY", Kind::Npy),
    (b"\x89HDF\r\n\x1a\n", Kind::Hdf5),
    (b"%PDF", Kind::Pdf),
    (b"<!DOCTYPE", Kind::Html),
    (b"<html", Kind::Html),
];

impl Kind {
    /// The kind of a file that starts with these bytes: at least [`ENOUGH`], or all of it.
    pub fn of(bytes: &[u8]) -> Kind {
        if bytes.is_empty() {
            return Kind::Empty;
        }
        if let Some((_, kind)) = MAGICS.iter().find(|(magic, _)| bytes.starts_with(magic)) {
            return *kind;
        }
        if bytes.starts_with(b"RIFF") && bytes.get(8..12) == Some(b"WEBP") {
            return Kind::WebP;
        }
        if bytes.starts_with(b"PK\x03\x04") || bytes.starts_with(b"PK\x05\x06") {
            return zip(bytes);
        }
        if bytes.starts_with(&[0x1f, 0x8b]) {
            return gzip(bytes);
        }
        let text = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
        if text.starts_with(b"ply") && matches!(text.get(3), Some(b'\r' | b'\n' | b' ')) {
            return ply(text);
        }
        text_kind(text).unwrap_or_else(|| binary(bytes))
    }

    /// What it is a kind of.
    pub fn group(self) -> Group {
        use Kind::*;
        match self {
            Stream => Group::Stream,
            Ply | Las | Pcd | E57 | Text => Group::Cloud,
            GaussianPly | CompressedPly | Spz | Sog | SogMeta | Splat | Ksplat => Group::Splats,
            Obj | Glb | Gltf | Stl | Fbx | Off => Group::Mesh,
            Png | Jpeg | WebP | Exr | Ppm | Gif | Tiff => Group::Picture,
            Zip | Gzip | Zstd | Xz | SevenZip => Group::Archive,
            Npz | Npy | Hdf5 | Pdf | Html | Json | Empty | Unknown => Group::Other,
        }
    }

    /// Its name with an article, for messages.
    pub fn name(self) -> &'static str {
        use Kind::*;
        match self {
            Stream => "a stream of b2p",
            Ply => "a PLY file",
            GaussianPly => "a PLY file of Gaussians",
            CompressedPly => "a compressed PLY file of Gaussians",
            Las => "a LAS or LAZ file",
            Pcd => "a PCD file",
            E57 => "an E57 file",
            Text => "a text file of numbers",
            Obj => "an OBJ file",
            Glb => "a GLB file",
            Gltf => "a glTF file",
            Spz => "an SPZ file of Gaussians",
            Sog => "a SOG file of Gaussians",
            SogMeta => "the metadata of a SOG file of Gaussians",
            Splat => "a .splat file of Gaussians",
            Ksplat => "a .ksplat file of Gaussians",
            Stl => "an STL mesh",
            Fbx => "an FBX scene",
            Off => "an OFF mesh",
            Png => "a PNG picture",
            Jpeg => "a JPEG picture",
            WebP => "a WebP picture",
            Exr => "an OpenEXR picture",
            Ppm => "a PPM picture",
            Gif => "a GIF picture",
            Tiff => "a TIFF picture",
            Zip => "a ZIP archive",
            Gzip => "a gzip file",
            Zstd => "a Zstandard file",
            Xz => "an xz file",
            SevenZip => "a 7z archive",
            Npz => "a numpy archive",
            Npy => "a numpy array",
            Hdf5 => "an HDF5 file",
            Pdf => "a PDF document",
            Html => "a web page",
            Json => "a JSON file",
            Empty => "an empty file",
            Unknown => "a file of unknown kind",
        }
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// The kind of a PLY file, by the properties that its header declares.
fn ply(bytes: &[u8]) -> Kind {
    let bytes = &bytes[..bytes.len().min(LONGEST_HEADER)];
    let end = bytes
        .windows(10)
        .position(|w| w == b"end_header")
        .unwrap_or(bytes.len());
    let header = &bytes[..end];
    let has = |word: &[u8]| header.split(|b| b.is_ascii_whitespace()).any(|w| w == word);
    match () {
        () if has(b"packed_position") && has(b"packed_rotation") => Kind::CompressedPly,
        () if has(b"rot_0") && has(b"scale_0") && has(b"opacity") => Kind::GaussianPly,
        () => Kind::Ply,
    }
}

/// The kind of a ZIP archive, by the name of its first member.
fn zip(bytes: &[u8]) -> Kind {
    let length = bytes
        .get(26..28)
        .map_or(0, |b| usize::from(u16::from_le_bytes([b[0], b[1]])));
    let name = bytes.get(30..30 + length).unwrap_or_default();
    // Any member may come first: each of a SOG is metadata in JSON or a WebP picture.
    match () {
        () if name.ends_with(b"meta.json") || name.ends_with(b".webp") => Kind::Sog,
        () if name.ends_with(b".npy") => Kind::Npz,
        () => Kind::Zip,
    }
}

/// The kind of a gzip file, by what it holds: SPZ of versions 1 to 3 is packed as a whole.
fn gzip(bytes: &[u8]) -> Kind {
    let mut start = [0; 4];
    let read = flate2::read::GzDecoder::new(bytes).read_exact(&mut start);
    match read.is_ok() && start == *b"NGSP" {
        true => Kind::Spz,
        false => Kind::Gzip,
    }
}

/// The kind of a file that may be text.
fn text_kind(bytes: &[u8]) -> Option<Kind> {
    let longest = &bytes[..bytes.len().min(LONGEST_HEADER)];
    let bytes = &bytes[..bytes.len().min(ENOUGH)];
    if bytes.iter().any(|b| *b < 9 || (14..32).contains(b))
        && !bytes.starts_with(b"# .PCD")
        && !bytes.starts_with(b"VERSION")
    {
        return None;
    }
    if bytes.trim_ascii_start().starts_with(b"{") {
        return Some(json(longest));
    }
    let lines = bytes.split(|b| matches!(b, b'\n' | b'\r')).map(<[u8]>::trim_ascii);
    let mut numbers = 0;
    let mut titles = 0;
    for line in lines.filter(|line| !line.is_empty()) {
        let first = line.split(|b| b.is_ascii_whitespace()).next().unwrap_or_default();
        if line.starts_with(b"# .PCD") || (first == b"VERSION" && line.len() < 20) || first == b"FIELDS" {
            return Some(Kind::Pcd);
        }
        if line.starts_with(b"#") || line.starts_with(b"//") || line.starts_with(b";") {
            continue;
        }
        if matches!(
            first,
            b"v" | b"vn" | b"vt" | b"vp" | b"f" | b"o" | b"g" | b"mtllib" | b"usemtl" | b"s" | b"l"
        ) {
            return Some(Kind::Obj);
        }
        match crate::clouds::text::row_of_numbers(line) {
            Some(0..=2) | None => titles += 1,
            Some(_) => numbers += 1,
        }
        // A title and, in PTS files, the number of points may come first.
        if titles > 2 || numbers > 2 {
            break;
        }
    }
    (numbers > 0 && titles <= 2).then_some(Kind::Text)
}

/// The kind of a JSON file, by the keys near its start.
fn json(bytes: &[u8]) -> Kind {
    let has = |key: &[u8]| bytes.windows(key.len()).any(|w| w == key);
    match () {
        () if has(b"\"asset\"") || (has(b"\"accessors\"") && has(b"\"bufferViews\"")) => Kind::Gltf,
        () if has(b"\"means\"") && has(b"\"quats\"") => Kind::SogMeta,
        () => Kind::Json,
    }
}

/// The kind of a binary file without a magic.
fn binary(bytes: &[u8]) -> Kind {
    // A binary STL: 80 bytes of anything, the number of triangles, and 50 bytes for each.
    if let Some(count) = bytes.get(80..84) {
        let count = u32::from_le_bytes([count[0], count[1], count[2], count[3]]);
        let is_whole = bytes.len() as u64 == 84 + 50 * u64::from(count);
        if count > 0 && is_whole {
            return Kind::Stl;
        }
    }
    let records = bytes.chunks_exact(32).take(64);
    if records.len() > 0 && records.clone().all(is_splat) {
        return Kind::Splat;
    }
    Kind::Unknown
}

/// Whether 32 bytes are plausible as a Gaussian: place, scales above 0, colour, and a quaternion of about unit length.
fn is_splat(record: &[u8]) -> bool {
    let float = |i: usize| f32::from_le_bytes([record[i], record[i + 1], record[i + 2], record[i + 3]]);
    let place = (0..3).all(|i| float(4 * i).abs() < 1e6);
    let scales = (3..6).all(|i| (1e-12..1e4).contains(&float(4 * i)));
    let square = |b: &u8| (f32::from(*b) - 128.0).powi(2);
    let length = record[28..32].iter().map(square).sum::<f32>().sqrt();
    place && scales && (100.0..156.0).contains(&length)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_recognised_by_their_first_bytes() {
        let splat_ply = "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float opacity\n\
                         property float scale_0\nproperty float rot_0\nend_header\n";
        let packed = "ply\nformat ascii 1.0\nelement vertex 0\nproperty uint packed_position\n\
                      property uint packed_rotation\nend_header\n";
        let cases: [(&[u8], Kind); 27] = [
            (b"", Kind::Empty),
            (&b2p::container::MAGIC, Kind::Stream),
            (b"ply\nformat ascii 1.0\n", Kind::Ply),
            (b"\xef\xbb\xbfply\rformat ascii 1.0\r", Kind::Ply),
            (splat_ply.as_bytes(), Kind::GaussianPly),
            (packed.as_bytes(), Kind::CompressedPly),
            (b"LASF\0\0", Kind::Las),
            (b"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n", Kind::Pcd),
            (b"VERSION .7\nFIELDS x y z\n", Kind::Pcd),
            (b"ASTM-E57\x01\0", Kind::E57),
            (b"1.0 2.0 3.0 255 0 0\n", Kind::Text),
            (b"x,y,z,r,g,b\n1,2,3,4,5,6\n", Kind::Text),
            (b"2\n1 2 3\n4 5 6\n", Kind::Text),
            (b"# Blender\nmtllib a.mtl\nv 1 2 3\n", Kind::Obj),
            (b"glTF\x02\0\0\0", Kind::Glb),
            (b"{ \"asset\": {\"version\": \"2.0\"}}", Kind::Gltf),
            (b"{ \"means\": {}, \"quats\": {}}", Kind::SogMeta),
            (b"{}", Kind::Json),
            (b"NGSP\x04\0\0\0", Kind::Spz),
            (b"\x1f\x8b\x08", Kind::Gzip),
            (b"\x89PNG\r\n\x1a\n", Kind::Png),
            (b"RIFF\0\0\0\0WEBPVP8L", Kind::WebP),
            (b"<!DOCTYPE html>", Kind::Html),
            (b"solid cube\nfacet", Kind::Stl),
            (b"some words\nand more\nand more\n", Kind::Unknown),
            (b"\x93NUMPY\x01", Kind::Npy),
            (b"\x00\x01\x02", Kind::Unknown),
        ];
        for (bytes, kind) in cases {
            assert_eq!(Kind::of(bytes), kind, "{:?}", String::from_utf8_lossy(bytes));
        }
    }

    #[test]
    fn packed_spz_is_distinguished_from_other_gzip_files() {
        let packed = |bytes: &[u8]| {
            let mut file = Vec::new();
            flate2::read::GzEncoder::new(bytes, flate2::Compression::fast())
                .read_to_end(&mut file)
                .unwrap();
            file
        };
        assert_eq!(Kind::of(&packed(b"NGSP\x02\0\0\0")), Kind::Spz);
        assert_eq!(Kind::of(&packed(b"a letter")), Kind::Gzip);
    }

    #[test]
    fn archives_are_known_by_their_first_member() {
        let zip = |name: &str| {
            let mut bytes = b"PK\x03\x04".to_vec();
            bytes.resize(30, 0);
            bytes[26] = name.len() as u8;
            bytes.extend(name.as_bytes());
            bytes
        };
        assert_eq!(Kind::of(&zip("meta.json")), Kind::Sog);
        assert_eq!(Kind::of(&zip("x.npy")), Kind::Npz);
        assert_eq!(Kind::of(&zip("letter.txt")), Kind::Zip);
        assert_eq!(Kind::of(&b"PK\x03\x04"[..]), Kind::Zip);
    }

    #[test]
    fn records_without_a_magic_are_judged_by_their_values() {
        let mut record = Vec::new();
        for value in [1.0f32, -2.0, 0.5, 0.01, 0.02, 0.03] {
            record.extend(value.to_le_bytes());
        }
        record.extend([255, 0, 0, 255, 255, 128, 128, 128]);
        let file = record.repeat(3);
        assert_eq!(Kind::of(&file), Kind::Splat);
        let mut wrong = file.clone();
        wrong[60..64].fill(128);
        assert_eq!(Kind::of(&wrong), Kind::Unknown);
        let mut stl = vec![7; 84 + 50];
        stl[80..84].copy_from_slice(&1u32.to_le_bytes());
        assert_eq!(Kind::of(&stl), Kind::Stl);
    }
}
