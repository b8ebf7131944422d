//! The scenes of the suite: what is unusual about them is in their names.

use b2p::cloud::ColouredVoxels;
use b2p::encoder::transform::QualityTarget;
use b2p::{Axes, SceneEncoder, Up};

use crate::common::{Ball, cloud_of, sparse_wall};

/// A scene, what is unusual about it in its name, and whether no float had a part in it, so that every machine makes
/// the same bytes.
pub fn cases() -> Vec<(&'static str, Vec<u8>, bool)> {
    let code = |cloud: &ColouredVoxels, levels, quality, most| {
        let encoder = SceneEncoder::new().with_levels(levels).with_block_voxels(most);
        let encoder = encoder.with_quality(quality).with_axes(Axes {
            up: Some(Up::Z),
            ..Axes::default()
        });
        encoder.encode(cloud).expect("a small cloud is coded")
    };
    let (step, lossless) = (QualityTarget::Step, QualityTarget::Lossless);
    let ball = Ball::new(5, 11.5).cloud();
    // Most of the voxels lie in one octant.
    let dense = (0..700).map(|i| i * 5);
    let lopsided = cloud_of(6, dense.chain((1..40).map(|i| i * 6500)).collect());
    let far = |i: u64| i.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 1;
    let [few, lone] = [12, 40].map(|count| cloud_of(21, (0..count).map(far).collect()));
    vec![
        ("ball", code(&ball, 3..=5, step(20.0), 500), false),
        ("one-block", code(&ball, 2..=4, step(40.0), 4000), false),
        ("blocks-of-many-sizes", code(&lopsided, 3..=5, step(40.0), 100), false),
        ("blocks-of-one-voxel", code(&few, 10..=12, step(200.0), 1), false),
        ("sparse-blocks", code(&sparse_wall(), 6..=7, step(100.0), 2200), false),
        ("exact", code(&lopsided, 2..=6, lossless, 200), true),
        ("exact-deepest", code(&lone, 21..=21, lossless, 5), true),
    ]
}
