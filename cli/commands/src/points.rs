//! Points out: of decoded voxels, of clouds, of the centres of Gaussians.

use std::path::Path;

use b2p::Error;
use b2p::cloud::PointCloud;
use b2p::gaussians::Gaussians;
use b2p::log::Log;
use b2p_formats::clouds::Encoded;

use super::{Result, manners, sidecar};

/// Writes a file of points and what belongs beside it, and says what was changed.
pub fn write(encoded: &Encoded, count: usize, to: &Path, log: &Log) -> Result<()> {
    for note in &encoded.notes {
        manners::warn(&format!("{}: {note}", to.display()));
    }
    sidecar::check(to, encoded.sidecar.as_ref())?;
    log.step("write points", count, "points", || {
        Ok(manners::write(to, |w| {
            w.write_all(&encoded.bytes).map_err(|source| Error::Io {
                path: to.to_path_buf(),
                source,
            })
        }))
    })??;
    sidecar::settle(to, encoded.sidecar.as_ref())
}

/// A point at the centre of every Gaussian that has one, with its colour.
pub fn centres(g: &Gaussians) -> PointCloud {
    let mut cloud = PointCloud::default();
    for (&position, colour) in g.position.iter().zip(&g.colour) {
        let place = g.frame.placement.from_cube(g.frame.bits, position);
        if place.iter().all(|x| x.is_finite()) {
            cloud.positions.push(place);
            let byte = |c: f32| (c * 255.0).round().clamp(0.0, 255.0) as u8;
            cloud.colours.push(colour.map(byte));
        }
    }
    cloud
}
