use super::super::glb::tests::glb;
use super::*;

/// The component type of unsigned bytes.
const UBYTE: u32 = 5121;

/// Collects accessors, one buffer view each.
#[derive(Default)]
struct File {
    data: Vec<u8>,
    views: Vec<String>,
    accessors: Vec<String>,
}

impl File {
    fn add(&mut self, kind: &str, component: u32, normalised: bool, bytes: &[u8], count: usize) -> usize {
        let (start, length) = (self.data.len(), bytes.len());
        self.data.extend(bytes);
        self.data.resize(self.data.len().next_multiple_of(4), 0);
        self.views
            .push(format!(r#"{{"buffer":0,"byteOffset":{start},"byteLength":{length}}}"#));
        let view = self.accessors.len();
        self.accessors.push(format!(
            r#"{{"bufferView":{view},"componentType":{component},"count":{count},"type":"{kind}","normalized":{normalised},"min":[0,0,0],"max":[1,1,1]}}"#
        ));
        view
    }

    fn floats(&mut self, kind: &str, width: usize, values: &[f32]) -> usize {
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.add(kind, 5126, false, &bytes, values.len() / width)
    }

    fn finish(&self, json: &str) -> Vec<u8> {
        let (views, accessors) = (self.views.join(","), self.accessors.join(","));
        let length = self.data.len();
        let tail =
            format!(r#","bufferViews":[{views}],"accessors":[{accessors}],"buffers":[{{"byteLength":{length}}}]"#);
        glb(&format!("{json}{tail}"), &self.data)
    }
}

const QUARTER: f32 = std::f32::consts::FRAC_1_SQRT_2;

/// A triangle over two bones. The lower stands at (0, 0, 0), the upper at (0, 1, 0), its child, which turns by 90
/// degrees around z within a second. Vertex 0 hangs on the lower bone, vertex 1 on the upper, vertex 2 on both.
fn two_bones() -> Vec<u8> {
    let mut file = File::default();
    file.floats("VEC3", 3, &[0., 0., 0., 0., 2., 0., 1., 1., 0.]);
    file.add("VEC4", UBYTE, false, &[0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0], 3);
    file.add("VEC4", UBYTE, true, &[255, 0, 0, 0, 255, 0, 0, 0, 51, 204, 0, 0], 3);
    let mut inverse = [0f32; 32];
    for i in 0..4 {
        inverse[5 * i] = 1.0;
        inverse[16 + 5 * i] = 1.0;
    }
    inverse[16 + 13] = -1.0;
    file.floats("MAT4", 16, &inverse);
    file.floats("SCALAR", 1, &[0.0, 1.0]);
    file.floats("VEC4", 4, &[0., 0., 0., 1., 0., 0., QUARTER, QUARTER]);
    file.finish(
        r#""scene":0,"scenes":[{"nodes":[0,1]}],
        "nodes":[{"mesh":0,"skin":0,"translation":[9,9,9]},{"children":[2]},{"translation":[0,1,0]}],
        "meshes":[{"primitives":[{"attributes":{"POSITION":0,"JOINTS_0":1,"WEIGHTS_0":2}}]}],
        "skins":[{"joints":[1,2],"inverseBindMatrices":3}],
        "animations":[{"samplers":[{"input":4,"output":5}],
            "channels":[{"sampler":0,"target":{"node":2,"path":"rotation"}}]}]"#,
    )
}

fn near(have: &[[f32; 3]], expected: [[f32; 3]; 3]) {
    for (a, b) in have.iter().flatten().zip(expected.iter().flatten()) {
        assert!((a - b).abs() < 1e-5, "{have:?}, expected {expected:?}");
    }
}

#[test]
fn a_skinned_mesh_of_two_bones_poses_as_computed_by_hand() {
    let animated = parse(&two_bones(), 0).unwrap();
    assert_eq!(animated.span(), [0.0, 1.0]);
    near(&animated.pose(0.0)[0], [[0., 0., 0.], [0., 2., 0.], [1., 1., 0.]]);
    // The upper bone takes (0, 2) to (−1, 1), and (1, 1) to (0, 2): a fifth of (1, 1) and four fifths of (0, 2).
    near(&animated.pose(1.0)[0], [[0., 0., 0.], [-1., 1., 0.], [0.2, 1.8, 0.]]);
    let half = std::f32::consts::FRAC_1_SQRT_2;
    let bent = [0.2 + 0.8 * half, 0.2 + 0.8 * (1.0 + half), 0.0];
    near(&animated.pose(0.5)[0], [[0., 0., 0.], [-half, 1.0 + half, 0.], bent]);
    assert_eq!(animated.pose(7.0), animated.pose(1.0));
}

/// A triangle under two nodes; the outer moves by (0, 0, 2) a second. A morph target lifts vertex 2 by 4.
fn morphing() -> Vec<u8> {
    let mut file = File::default();
    file.floats("VEC3", 3, &[0., 0., 0., 1., 0., 0., 0., 1., 0.]);
    file.floats("VEC3", 3, &[0., 0., 0., 0., 0., 0., 0., 4., 0.]);
    file.floats("SCALAR", 1, &[0.0, 1.0]);
    file.floats("SCALAR", 1, &[0.0, 1.0]);
    file.floats("VEC3", 3, &[0., 0., 0., 0., 0., 2.]);
    file.finish(
        r#""scene":0,"scenes":[{"nodes":[0]}],
        "nodes":[{"children":[1]},{"mesh":0,"scale":[2,2,2]}],
        "meshes":[{"primitives":[{"attributes":{"POSITION":0},"targets":[{"POSITION":1}]}]}],
        "animations":[{"samplers":[{"input":2,"output":3},{"input":2,"output":4}],
            "channels":[{"sampler":0,"target":{"node":1,"path":"weights"}},
                {"sampler":1,"target":{"node":0,"path":"translation"}}]}]"#,
    )
}

#[test]
fn morph_targets_and_the_nodes_above_move_a_mesh_without_skin() {
    let animated = parse(&morphing(), 0).unwrap();
    near(&animated.pose(0.0)[0], [[0., 0., 0.], [2., 0., 0.], [0., 2., 0.]]);
    near(&animated.pose(0.5)[0], [[0., 0., 1.], [2., 0., 1.], [0., 6., 1.]]);
}

#[test]
fn a_missing_animation_is_an_error_that_says_how_many_there_are() {
    let error = parse(&two_bones(), 1).unwrap_err();
    assert!(error.contains("the file has 1"), "{error}");
}

#[test]
fn a_file_cut_anywhere_is_an_error_and_no_panic() {
    for whole in [two_bones(), morphing()] {
        for end in 0..whole.len() {
            assert!(parse(&whole[..end], 0).is_err(), "{end}");
        }
    }
}
