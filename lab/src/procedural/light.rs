//! Light that is baked into textures: pictures are drawn unlit, as photographs on a surface are.

use glam::Vec3;

/// A key light from one side, a sky above, and balls that stand in each other's sky.
#[derive(Debug, Clone)]
pub struct Light {
    /// Direction to the key light, of unit length.
    pub to_key: Vec3,
    /// What the key adds where the surface faces it.
    pub key: Vec3,
    /// What the sky gives a surface that faces up.
    pub sky: Vec3,
    /// What the ground gives a surface that faces down.
    pub ground: Vec3,
    /// Centres and radii of balls that darken what is near them.
    pub occluders: Vec<(Vec3, f32)>,
}

impl Light {
    /// A warm key from the upper left front and a cool sky.
    pub fn studio() -> Self {
        Light {
            to_key: Vec3::new(-0.5, 0.7, 0.51).normalize(),
            key: Vec3::new(0.52, 0.49, 0.44),
            sky: Vec3::new(0.62, 0.65, 0.70),
            ground: Vec3::new(0.44, 0.41, 0.39),
            occluders: Vec::new(),
        }
    }

    /// What a surface's colour is multiplied by.
    pub fn shade(&self, position: Vec3, normal: Vec3) -> Vec3 {
        let facing = self.to_key.dot(normal);
        let wrapped = ((facing + 0.35) / 1.35).max(0.0);
        let upward = 0.5 + 0.5 * normal.y;
        let open: f32 = self
            .occluders
            .iter()
            .map(|&(centre, radius)| {
                let to = centre - position;
                let distance = to.length().max(radius);
                let facing = (normal.dot(to) / distance).clamp(0.0, 1.0);
                1.0 - 0.85 * facing * (radius / distance).powi(2)
            })
            .product();
        (self.ground.lerp(self.sky, upward) + self.key * wrapped) * open
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn facing_the_key_is_brighter_than_facing_away() {
        let light = Light::studio();
        let lit = light.shade(Vec3::ZERO, light.to_key);
        let unlit = light.shade(Vec3::ZERO, -light.to_key);
        assert!(lit.cmpgt(unlit).all());
    }

    #[test]
    fn a_ball_darkens_only_what_faces_it_and_less_from_a_distance() {
        let mut light = Light::studio();
        let open = light.shade(Vec3::ZERO, Vec3::Y);
        light.occluders.push((Vec3::Y, 0.5));
        let near = light.shade(Vec3::ZERO, Vec3::Y);
        let far = light.shade(-Vec3::Y, Vec3::Y);
        assert!(near.cmplt(far).all() && far.cmplt(open).all());
        light.occluders[0].0 = -Vec3::Y;
        assert_eq!(light.shade(Vec3::ZERO, Vec3::Y), open);
    }
}
