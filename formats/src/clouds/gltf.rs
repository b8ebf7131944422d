//! Points of glTF and GLB files: primitives of mode POINTS, placed by the nodes of the scene.

use std::path::{Path, PathBuf};

use b2p::cloud::{Note, RawColours, RawPoints, ReadOptions, Stored, is_a_mesh};
use b2p::{Axes, Limits, Result, Up};
use base64::Engine as _;
use base64::alphabet::STANDARD;
use base64::engine::{DecodePaddingMode, GeneralPurpose, GeneralPurposeConfig};
use gltf::buffer::Source;
use gltf::mesh::Mode;
use gltf::mesh::util::ReadColors;
use gltf::{Gltf, Node};

use super::{guarded, malformed, read_file};

/// Nodes above a node at most.
const DEEPEST: usize = 64;
/// Nodes that are visited at most: a node may have several parents in a file that is not valid.
const MOST_NODES: usize = 1 << 20;

type Matrix = [[f64; 4]; 4];

const IDENTITY: Matrix = [
    [1.0, 0.0, 0.0, 0.0],
    [0.0, 1.0, 0.0, 0.0],
    [0.0, 0.0, 1.0, 0.0],
    [0.0, 0.0, 0.0, 1.0],
];

/// Reads the points of the file's scene. `folder` is where files beside it are.
///
/// # Errors
/// [`b2p::Error::Unsupported`] if there are triangles but no points; [`b2p::Error::Malformed`],
/// [`b2p::Error::LimitExceeded`], [`b2p::Error::Io`] for files beside it.
pub(super) fn read(
    bytes: &[u8],
    folder: Option<&Path>,
    limits: &Limits,
    options: &ReadOptions,
    notes: &mut Vec<Note>,
) -> Result<RawPoints> {
    guarded("glTF", || {
        let file = Gltf::from_slice(bytes).map_err(|e| malformed("the file", "glTF data", e, "a valid file"))?;
        let buffers = buffers(&file, folder, limits)?;
        let mut scene = Scene::new(&buffers, limits, options);
        let roots = file.default_scene().or_else(|| file.scenes().next());
        match roots {
            Some(roots) => {
                for node in roots.nodes() {
                    scene.visit(&node, &IDENTITY, 0)?;
                }
            }
            None => {
                for mesh in file.meshes() {
                    scene.mesh(&mesh, &IDENTITY)?;
                }
            }
        }
        scene.finish(notes)
    })
}

/// The bytes of every buffer: in the file, in a data URI, or in a file beside it.
fn buffers(file: &Gltf, folder: Option<&Path>, limits: &Limits) -> Result<Vec<Vec<u8>>> {
    let mut buffers = Vec::new();
    let mut total = 0u64;
    for (i, buffer) in file.buffers().enumerate() {
        let bad = |value: &str, expected: &str| malformed("the file", format!("buffer {i}"), value, expected);
        total = total.saturating_add(buffer.length() as u64);
        limits.check_bytes("bytes of the glTF buffers", total)?;
        let bytes = match buffer.source() {
            Source::Bin => file
                .blob
                .clone()
                .ok_or_else(|| bad("absent", "the binary chunk of a GLB file"))?,
            Source::Uri(uri) => match uri.strip_prefix("data:") {
                Some(data) => {
                    let (_, code) = data.split_once(";base64,").ok_or_else(|| bad("a data URI", "base64"))?;
                    decoded(code.as_bytes()).ok_or_else(|| bad("a data URI", "valid base64"))?
                }
                None => read_file(
                    &beside(uri, folder).ok_or_else(|| bad(uri, "the name of a file beside it"))?,
                    limits,
                )?,
            },
        };
        if bytes.len() < buffer.length() {
            return Err(bad(
                &format!("{} bytes long", bytes.len()),
                &format!("{}", buffer.length()),
            ));
        }
        buffers.push(bytes);
    }
    Ok(buffers)
}

/// The path of a file in the folder or below. `None` for any other path: a file must not name what lies elsewhere.
fn beside(uri: &str, folder: Option<&Path>) -> Option<PathBuf> {
    let name = uri.replace("%20", " ");
    let path = Path::new(&name);
    let inside = path.components().all(|c| matches!(c, std::path::Component::Normal(_)));
    (inside && !name.contains("://")).then(|| folder.map(|folder| folder.join(path)))?
}

/// Decodes base64, with or without padding.
fn decoded(code: &[u8]) -> Option<Vec<u8>> {
    let config = GeneralPurposeConfig::new().with_decode_padding_mode(DecodePaddingMode::Indifferent);
    GeneralPurpose::new(&STANDARD, config).decode(code.trim_ascii()).ok()
}

struct Scene<'a> {
    buffers: &'a [Vec<u8>],
    limits: &'a Limits,
    options: &'a ReadOptions,
    visited: usize,
    triangles: u64,
    positions: Vec<[f64; 3]>,
    colours: Vec<[f32; 3]>,
    /// Whether any primitive has colours.
    coloured: bool,
}

impl<'a> Scene<'a> {
    fn new(buffers: &'a [Vec<u8>], limits: &'a Limits, options: &'a ReadOptions) -> Self {
        Scene {
            buffers,
            limits,
            options,
            visited: 0,
            triangles: 0,
            positions: Vec::new(),
            colours: Vec::new(),
            coloured: false,
        }
    }

    fn visit(&mut self, node: &Node, above: &Matrix, depth: usize) -> Result<()> {
        self.visited += 1;
        if depth > DEEPEST || self.visited > MOST_NODES {
            let expected = format!("a tree of at most {DEEPEST} levels and {MOST_NODES} nodes");
            return Err(malformed("the file", "nodes", "deeper or more", expected));
        }
        let local = node.transform().matrix().map(|column| column.map(f64::from));
        let matrix = product(above, &local);
        if let Some(mesh) = node.mesh() {
            self.mesh(&mesh, &matrix)?;
        }
        for child in node.children() {
            self.visit(&child, &matrix, depth + 1)?;
        }
        Ok(())
    }

    fn mesh(&mut self, mesh: &gltf::Mesh, matrix: &Matrix) -> Result<()> {
        for primitive in mesh.primitives() {
            if primitive.mode() != Mode::Points && !self.options.vertices {
                self.triangles += 1;
                continue;
            }
            let count = primitive
                .get(&gltf::Semantic::Positions)
                .map_or(0, |accessor| accessor.count());
            let total = (self.positions.len() + count) as u64;
            self.limits.check_points("number of points", total)?;
            self.limits.check_bytes("bytes of the point cloud", total * 36)?;
            let reader = primitive.reader(|buffer| self.buffers.get(buffer.index()).map(Vec::as_slice));
            let positions = reader.read_positions().ok_or_else(|| {
                malformed(
                    "the file",
                    format!("POSITION of mesh {}", mesh.index()),
                    "absent",
                    "an accessor within its buffer",
                )
            })?;
            let before = self.positions.len();
            self.positions
                .extend(positions.map(|p| placed(matrix, p.map(f64::from))));
            let added = self.positions.len() - before;
            match reader.read_colors(0) {
                Some(colours) => {
                    self.coloured = true;
                    self.colours.extend(linear_to_srgb(colours).take(added));
                }
                None => self.colours.extend(std::iter::repeat_n([1.0; 3], added)),
            }
            if self.colours.len() != self.positions.len() {
                let expected = format!("{added}, as there are points");
                return Err(malformed(
                    "the file",
                    "number of COLOR_0",
                    self.colours.len() - before,
                    expected,
                ));
            }
        }
        Ok(())
    }

    fn finish(self, notes: &mut Vec<Note>) -> Result<RawPoints> {
        if self.positions.is_empty() && self.triangles > 0 {
            return Err(is_a_mesh(" without points"));
        }
        if self.triangles > 0 {
            notes.push(Note::Other(format!(
                "left out {} primitives that are not points",
                self.triangles
            )));
        }
        Ok(RawPoints {
            positions: self.positions,
            colours: match self.coloured {
                true => RawColours::Rgb(self.colours, Stored::Float),
                false => RawColours::None,
            },
            // The specification has metres and y up.
            axes: Axes {
                up: Some(Up::Y),
                metres_per_unit: Some(1.0),
                ..Axes::default()
            },
            ..RawPoints::default()
        })
    }
}

/// Colours of vertices are linear in glTF.
fn linear_to_srgb<'s>(colours: ReadColors<'s>) -> impl Iterator<Item = [f32; 3]> + 's {
    colours.into_rgb_f32().map(|rgb| {
        rgb.map(|c| match c {
            c if c <= 0.003_130_8 => 12.92 * c,
            c => 1.055 * c.powf(1.0 / 2.4) - 0.055,
        })
    })
}

/// The product of matrices in columns.
fn product(a: &Matrix, b: &Matrix) -> Matrix {
    b.map(|column| std::array::from_fn(|row| (0..4).map(|k| a[k][row] * column[k]).sum()))
}

fn placed(matrix: &Matrix, p: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|row| (0..3).map(|k| matrix[k][row] * p[k]).sum::<f64>() + matrix[3][row])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A scene of two points with byte colours, moved by a node within a node, and as much else as `extra` says.
    fn scene(mode: u32, uri: &str) -> String {
        let buffer = match uri {
            "" => "{\"byteLength\": 32}".to_owned(),
            uri => format!("{{\"byteLength\": 32, \"uri\": \"{uri}\"}}"),
        };
        format!(
            "{{\"asset\": {{\"version\": \"2.0\"}}, \"scene\": 0, \"scenes\": [{{\"nodes\": [0]}}],
            \"nodes\": [{{\"children\": [1], \"translation\": [10, 0, 0]}}, {{\"mesh\": 0, \"scale\": [2, 2, 2]}}],
            \"meshes\": [{{\"primitives\": [{{\"mode\": {mode}, \"attributes\": {{\"POSITION\": 0, \"COLOR_0\": 1}}}}]}}],
            \"accessors\": [
              {{\"bufferView\": 0, \"componentType\": 5126, \"count\": 2, \"type\": \"VEC3\", \"min\": [0,0,0], \"max\": [1,2,3]}},
              {{\"bufferView\": 1, \"componentType\": 5121, \"normalized\": true, \"count\": 2, \"type\": \"VEC4\"}}],
            \"bufferViews\": [{{\"buffer\": 0, \"byteLength\": 24}}, {{\"buffer\": 0, \"byteOffset\": 24, \"byteLength\": 8}}],
            \"buffers\": [{buffer}]}}"
        )
    }

    fn data() -> Vec<u8> {
        let mut data = Vec::new();
        for x in [1.0f32, 2.0, 3.0, 0.0, 0.0, 0.0] {
            data.extend(x.to_le_bytes());
        }
        data.extend([255, 0, 55, 255, 0, 255, 0, 255]);
        data
    }

    fn glb(json: &str) -> Vec<u8> {
        let mut json = json.as_bytes().to_vec();
        json.resize(json.len().next_multiple_of(4), b' ');
        let data = data();
        let mut bytes = b"glTF\x02\0\0\0".to_vec();
        bytes.extend((12 + 8 + json.len() as u32 + 8 + data.len() as u32).to_le_bytes());
        bytes.extend((json.len() as u32).to_le_bytes());
        bytes.extend(b"JSON");
        bytes.extend(json);
        bytes.extend((data.len() as u32).to_le_bytes());
        bytes.extend(b"BIN\0");
        bytes.extend(data);
        bytes
    }

    fn parse(bytes: &[u8], folder: Option<&Path>) -> Result<b2p::cloud::PointCloud> {
        let options = ReadOptions::default();
        let raw = read(bytes, folder, &Limits::default(), &options, &mut Vec::new())?;
        Ok(raw.finish(&options)?.0)
    }

    #[test]
    fn points_are_read_with_their_nodes_from_any_kind_of_buffer() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("points 1.bin"), data()).unwrap();
        let uri = format!(
            "data:application/octet-stream;base64,{}",
            ::base64::engine::general_purpose::STANDARD.encode(data())
        );
        let files = [
            glb(&scene(0, "")),
            scene(0, &uri).into_bytes(),
            scene(0, "points%201.bin").into_bytes(),
        ];
        for file in files {
            let cloud = parse(&file, Some(folder.path())).unwrap();
            assert_eq!(cloud.positions, [[12.0, 4.0, 6.0], [10.0, 0.0, 0.0]]);
            // 55 of 255 in linear light.
            assert_eq!(cloud.colours, [[255, 0, 128], [0, 255, 0]]);
            assert_eq!(cloud.axes.up, Some(Up::Y));
        }
    }

    #[test]
    fn triangles_are_refused_as_a_mesh() {
        let error = parse(&glb(&scene(4, "")), None).unwrap_err().to_string();
        assert!(
            error.contains("this is a mesh") && error.contains("voxelize"),
            "{error}"
        );
    }

    #[test]
    fn buffers_elsewhere_or_too_short_are_refused() {
        for uri in [
            "/etc/passwd",
            "../secret.bin",
            "http://example.org/a.bin",
            "data:;base64,AAAA",
            "data:,x",
        ] {
            let error = parse(scene(0, uri).as_bytes(), Some(Path::new(".")))
                .unwrap_err()
                .to_string();
            assert!(error.contains("buffer 0"), "{uri}: {error}");
        }
    }

    #[test]
    fn files_that_are_cut_or_damaged_are_errors_and_nothing_panics() {
        let file = glb(&scene(0, ""));
        for length in (0..file.len()).step_by(5) {
            assert!(parse(&file[..length], None).is_err(), "cut at {length}");
        }
        for at in (20..file.len()).step_by(3) {
            let mut damaged = file.clone();
            damaged[at] = b'9';
            let _ = parse(&damaged, None);
        }
    }
}
