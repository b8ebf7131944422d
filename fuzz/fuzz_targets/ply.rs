//! Any bytes as a point cloud and as Gaussians: an error, or arrays of equal length.
#![no_main]

use b2p::Limits;
use b2p::cloud::{PointCloud, voxelise};
use b2p::gaussians::Gaussians;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let limits = Limits {
        max_points: 1 << 16,
        ..Limits::default()
    };
    if let Ok(cloud) = PointCloud::from_ply(bytes, &limits) {
        assert_eq!(cloud.positions.len(), cloud.colours.len());
        if let Ok(voxels) = voxelise(&cloud, None) {
            assert_eq!(voxels.voxels.len(), voxels.colours.len());
            assert!(voxels.voxels.len() <= cloud.positions.len());
        }
    }
    if let Ok(gaussians) = Gaussians::from_ply(bytes, &limits) {
        assert_eq!(gaussians.position.len(), gaussians.rotation.len());
    }
});
