//! Gaussians as points: their centres, with their colour from the front.

use b2p::Limits;
use b2p::Result;
use b2p::cloud::{Note, RawColours, RawPoints};
use b2p::gaussians::Gaussians;

/// Gaussians that are more transparent than this are no surface.
const FAINT: f32 = 0.1;

/// Reads a PLY file of Gaussians.
///
/// # Errors
/// Those of [`Gaussians::from_ply`].
pub(super) fn read(bytes: &[u8], limits: &Limits, notes: &mut Vec<Note>) -> Result<RawPoints> {
    Ok(points(&Gaussians::from_ply(bytes, limits)?, notes))
}

/// The centres of Gaussians in world units.
pub(super) fn points(gaussians: &Gaussians, notes: &mut Vec<Note>) -> RawPoints {
    let seen: Vec<usize> = (0..gaussians.len())
        .filter(|i| gaussians.opacity[*i] >= FAINT)
        .collect();
    notes.push(Note::Other(format!(
        "Gaussians: {} of {} centres are taken as points, the others are nearly transparent",
        seen.len(),
        gaussians.len()
    )));
    let frame = gaussians.frame;
    let world = |i: &usize| frame.placement.from_cube(frame.bits, gaussians.position[*i]);
    let byte = |c: f32| (c * 255.0).round().clamp(0.0, 255.0) as u8;
    RawPoints {
        positions: seen.iter().map(world).collect(),
        colours: RawColours::Bytes(seen.iter().map(|i| gaussians.colour[*i].map(byte)).collect()),
        ..RawPoints::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use b2p::cloud::ReadOptions;

    #[test]
    fn gaussians_give_their_centres_and_colours_as_points() {
        let gaussians = Gaussians {
            position: vec![[0.5, -0.25, 0.0], [0.0; 3]],
            scale: vec![[0.01; 3]; 2],
            rotation: vec![[1.0, 0.0, 0.0, 0.0]; 2],
            opacity: vec![0.9, 0.01],
            colour: vec![[1.0, 0.5, 0.0], [0.0; 3]],
            ..Gaussians::default()
        };
        let mut file = Vec::new();
        gaussians.write_ply(&mut file, std::path::Path::new("memory")).unwrap();
        let mut notes = Vec::new();
        let raw = read(&file, &Limits::default(), &mut notes).unwrap();
        let (cloud, _) = raw.finish(&ReadOptions::default()).unwrap();
        let frame = gaussians.frame;
        let expected = frame.placement.from_cube(frame.bits, gaussians.position[0]);
        assert_eq!(cloud.positions.len(), 1);
        assert!((0..3).all(|i| (cloud.positions[0][i] - expected[i]).abs() < 1e-3));
        assert_eq!(cloud.colours, [[255, 128, 0]]);
        assert!(notes[0].to_string().contains("1 of 2 centres"), "{notes:?}");
    }
}
