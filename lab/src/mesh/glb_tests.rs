use super::*;

/// A glTF binary of these JSON fields (after `asset`) and data.
pub(crate) fn glb(json: &str, data: &[u8]) -> Vec<u8> {
    let pad = |bytes: &[u8], with: u8| {
        let mut bytes = bytes.to_vec();
        bytes.resize(bytes.len().next_multiple_of(4), with);
        bytes
    };
    let json = format!(r#"{{"asset":{{"version":"2.0"}},{json}}}"#);
    let (json, data) = (pad(json.as_bytes(), b' '), pad(data, 0));
    let total = 12 + 8 + json.len() + 8 + data.len();
    let mut file = b"glTF".to_vec();
    for word in [2, total as u32, json.len() as u32] {
        file.extend(word.to_le_bytes());
    }
    file.extend(b"JSON");
    file.extend(json);
    file.extend((data.len() as u32).to_le_bytes());
    file.extend(b"BIN\0");
    file.extend(data);
    file
}

/// One triangle (0,0,0) (1,0,0) (0,1,0) with 8-bit indices, under a node with this transform.
fn triangle(node: &str, indices: [u8; 3], positions_offset: usize) -> Vec<u8> {
    let mut data = Vec::new();
    for x in [0f32, 0., 0., 1., 0., 0., 0., 1., 0.] {
        data.extend(x.to_le_bytes());
    }
    data.extend(indices);
    let json = format!(
        r#""scene":0,"scenes":[{{"nodes":[0]}}],"nodes":[{{"mesh":0{node}}}],
        "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}},"indices":1,"material":0}}]}}],
        "materials":[{{"pbrMetallicRoughness":{{"baseColorFactor":[1,0.5,0,1]}}}}],
        "accessors":[
            {{"bufferView":0,"byteOffset":{positions_offset},"componentType":5126,"count":3,"type":"VEC3","min":[0,0,0],"max":[1,1,0]}},
            {{"bufferView":1,"componentType":5121,"count":3,"type":"SCALAR"}}],
        "bufferViews":[{{"buffer":0,"byteLength":36}},{{"buffer":0,"byteOffset":36,"byteLength":3}}],
        "buffers":[{{"byteLength":39}}]"#
    );
    glb(&json, &data)
}

#[test]
fn a_triangle_is_read_with_its_colour() {
    let mesh = parse(&triangle("", [0, 1, 2], 0)).unwrap();
    let part = &mesh.parts[0];
    assert_eq!(part.positions, [[0., 0., 0.], [1., 0., 0.], [0., 1., 0.]]);
    assert_eq!(part.triangles, [[0, 1, 2]]);
    assert_eq!(part.factor, [1.0, 0.5, 0.0, 1.0]);
    assert!(part.texture.is_none() && part.uvs.is_empty());
}

#[test]
fn a_nodes_transform_moves_its_mesh() {
    let mesh = parse(&triangle(r#","translation":[1,2,3],"scale":[2,2,2]"#, [0, 1, 2], 0)).unwrap();
    assert_eq!(mesh.parts[0].positions, [[1., 2., 3.], [3., 2., 3.], [1., 4., 3.]]);
}

#[test]
fn what_points_outside_is_refused_by_name() {
    let error = parse(&triangle("", [0, 1, 3], 0)).unwrap_err();
    assert!(error.contains("index 3"), "{error}");
    let error = parse(&triangle("", [0, 1, 2], 8)).unwrap_err();
    assert!(error.contains("POSITION"), "{error}");
}

#[test]
fn a_file_cut_anywhere_is_an_error_and_no_panic() {
    let whole = triangle("", [0, 1, 2], 0);
    for end in 0..whole.len() {
        assert!(parse(&whole[..end]).is_err(), "{end}");
    }
}

#[test]
fn a_missing_file_is_named() {
    let error = load(Path::new("no/such.glb")).unwrap_err();
    assert!(error.to_string().contains("no/such.glb"), "{error}");
}

#[test]
fn a_real_mesh_is_read_whole_if_the_real_meshes_are_beside_the_checkout() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data/train/spot.glb");
    if !path.exists() {
        return;
    }
    let mesh = load(&path).unwrap();
    assert_eq!(mesh.parts.len(), 1);
    let part = &mesh.parts[0];
    assert_eq!(part.triangles.len(), 5856);
    assert_eq!(part.uvs.len(), part.positions.len());
    assert!(part.texture.as_ref().is_some_and(|t| t.width <= 1024));
}
