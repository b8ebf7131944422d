//! The painted things of the still life: vase, plaque, books, tower, plinth.

use std::f32::consts::TAU;
use std::sync::Arc;

use glam::{Vec2, Vec3};

use super::font;
use super::patch::{Pattern, Spot};
use super::pattern::hsv;
use super::rng::{fractal, lattice, value_noise};

const CREAM: Vec3 = Vec3::new(0.95, 0.91, 0.82);
const COBALT: Vec3 = Vec3::new(0.08, 0.17, 0.50);
const TERRACOTTA: Vec3 = Vec3::new(0.74, 0.31, 0.16);
const INK: Vec3 = Vec3::new(0.07, 0.07, 0.09);

/// One repeat of a meander, eight by seven, the leftmost column in bit 7.
const MEANDER: [u8; 7] = [
    0b1111_1111,
    0b1000_0000,
    0b1011_1110,
    0b1010_0010,
    0b1011_1010,
    0b1000_0010,
    0b1111_1110,
];

/// Cobalt and terracotta bands on cream, from the lip down: rings, zigzag, rosettes, a meander, tongues.
pub fn vase() -> Pattern {
    Arc::new(|s: &Spot| {
        let glaze = CREAM * (0.97 + 0.05 * fractal(s.position * 14.0, 4, 7));
        let band = |top: f32, bottom: f32| {
            let t = (s.uv.y - top) / (bottom - top);
            (0.0..1.0).contains(&t).then_some(t)
        };
        let ring = [0.03, 0.25, 0.262, 0.352, 0.364, 0.60, 0.612, 0.70, 0.712, 0.955];
        if ring.iter().any(|&y| (s.uv.y - y).abs() < 0.0032) {
            return COBALT;
        }
        if let Some(t) = band(0.27, 0.346) {
            let x = s.uv.x * 30.0;
            let tooth = 2.0 * (x - x.floor() - 0.5).abs();
            return if tooth > t { TERRACOTTA } else { COBALT };
        }
        if let Some(t) = band(0.375, 0.59) {
            return rosettes(Vec2::new(s.uv.x * 7.0, t), glaze);
        }
        if let Some(t) = band(0.622, 0.69) {
            let x = ((s.uv.x * 36.0).fract() * 8.0) as u32;
            let row = MEANDER[(t * 7.0) as usize];
            return if row >> (7 - x) & 1 == 1 { COBALT } else { glaze };
        }
        if let Some(t) = band(0.725, 0.94) {
            let x = (s.uv.x * 24.0).fract() - 0.5;
            let edge = 0.46 * (1.0 - t * t).sqrt();
            return if x.abs() > edge {
                glaze
            } else if x.abs() > edge - 0.12 {
                COBALT
            } else {
                TERRACOTTA.lerp(CREAM, 0.5 * t)
            };
        }
        glaze
    })
}

/// Flowers of six petals with dots between them; `p.x` counts flowers.
fn rosettes(p: Vec2, ground: Vec3) -> Vec3 {
    // Cells are higher than wide.
    let to = Vec2::new(p.x.fract() - 0.5, 1.35 * (p.y - 0.5));
    let (distance, angle) = (to.length(), to.y.atan2(to.x));
    let petal = 0.33 + 0.13 * (6.0 * angle).cos();
    if distance < 0.085 {
        hsv(0.12, 0.8, 0.95)
    } else if distance < petal - 0.05 {
        let vein = (18.0 * angle).cos() > 0.86;
        if vein {
            CREAM
        } else {
            COBALT.lerp(hsv(0.58, 0.75, 0.85), distance / petal)
        }
    } else if distance < petal {
        COBALT
    } else if Vec2::new((p.x + 0.5).fract() - 0.5, 1.35 * (p.y - 0.5).abs() - 0.5).length() < 0.06 {
        TERRACOTTA
    } else {
        ground
    }
}

/// Lines of text one below the other: what each says, and the size of its dots. Left edge and top at `corner`.
fn lines(st: Vec2, corner: Vec2, lines: &[(&str, f32)]) -> bool {
    let mut top = corner.y;
    for &(text, dot) in lines {
        let height = dot * (font::HEIGHT + 3) as f32;
        if (top..top + height).contains(&st.y) {
            let place = (st - Vec2::new(corner.x, top)) / dot;
            let text: Vec<char> = text.chars().collect();
            return place.x >= 0.0 && font::dot(&text, place.x as u32, place.y as u32);
        }
        top += height;
    }
    false
}

/// The plaque's text, each line smaller than the one above, down to dots of about one voxel of a 10-bit cloud.
pub fn plaque(size: Vec2) -> Pattern {
    const TEXT: [(&str, f32); 7] = [
        ("b2p", 0.0105),
        ("bits to photon", 0.0038),
        ("A cloud of points goes", 0.0024),
        ("in, Gaussians come out.", 0.0022),
        ("The quick brown fox jumps", 0.0021),
        ("over the lazy dog. 0123", 0.0023),
        ("{f(x)} [1/2] <&> \"@#$%\"", 0.0020),
    ];
    Arc::new(move |s: &Spot| {
        let edge = s.st.min(size - s.st).min_element();
        let paper = CREAM * (0.96 + 0.05 * fractal(s.position * 30.0, 4, 11));
        if (0.008..0.011).contains(&edge) {
            return TERRACOTTA;
        }
        if edge < 0.004 || lines(s.st, Vec2::new(0.020, 0.024), &TEXT) {
            return INK;
        }
        // Colour bars right of the title, where its line leaves room.
        let bar = (s.st - Vec2::new(size.x - 0.124, 0.028)) / Vec2::new(0.0128, 0.033);
        if (0.0..8.0).contains(&bar.x) && (0.0..2.0).contains(&bar.y) {
            let t = bar.x.floor();
            return if bar.y < 1.0 {
                hsv(t / 8.0, 1.0, 1.0)
            } else {
                Vec3::splat(t / 7.0)
            };
        }
        paper
    })
}

/// A cloth cover with a title in gold, once across.
pub fn cover(cloth: Vec3, title: &'static str, dot: f32) -> Pattern {
    let gold = hsv(0.12, 0.55, 0.92);
    Arc::new(move |s: &Spot| {
        if lines(s.st, Vec2::new(0.016, 0.012), &[(title, dot)]) {
            return gold;
        }
        let thread = s.st / 0.004;
        let over = (thread.x.floor() + thread.y.floor()).rem_euclid(2.0);
        cloth * (0.88 + 0.16 * over)
    })
}

/// The cut edges of a block of pages.
pub fn pages() -> Pattern {
    Arc::new(|s: &Spot| {
        let sheet = (s.position.y / 0.0035).floor() as i32;
        CREAM * (0.80 + 0.18 * lattice(sheet, 0, 0, 3))
    })
}

/// Bricks with dark windows that have light frames; for a lathe `around` and `height` long.
pub fn tower(around: f32) -> Pattern {
    Arc::new(move |s: &Spot| {
        let window = Vec2::new((s.uv.x * 6.0).fract() - 0.5, (s.st.y / 0.085).fract() - 0.55);
        let wide = window * Vec2::new(around / 6.0, 0.085);
        let inside = wide.x.abs() < 0.011 && wide.y.abs() < 0.018;
        let frame = wide.x.abs() < 0.015 && wide.y.abs() < 0.022;
        if inside {
            let bar = wide.x.abs() < 0.002 || wide.y.abs() < 0.002;
            return if bar { CREAM } else { Vec3::new(0.06, 0.09, 0.14) };
        }
        if frame {
            return CREAM;
        }
        let y = s.st.y / 0.0125;
        let x = s.st.x / (around / 18.0) + 0.5 * y.floor().rem_euclid(2.0);
        if x.fract() < 0.07 || y.fract() < 0.16 {
            return Vec3::new(0.78, 0.74, 0.68);
        }
        let tone = lattice(x.floor() as i32 % 18, y.floor() as i32, 0, 5);
        Vec3::new(0.66, 0.27, 0.19) * (0.72 + 0.5 * tone)
    })
}

/// Squares of light and dark stone in the middle, a ring of tiles around them.
pub fn floor(radius: f32) -> Pattern {
    let (light, dark) = (Vec3::new(0.88, 0.86, 0.82), Vec3::new(0.20, 0.22, 0.25));
    Arc::new(move |s: &Spot| {
        let p = s.position;
        let distance = p.x.hypot(p.z) / radius;
        let vein = 0.5 + 0.5 * fractal(p * 9.0, 5, 21);
        if distance > 0.93 {
            let tile = s.uv.x * 72.0;
            let grout = tile.fract() < 0.1 || !(0.94..0.985).contains(&distance);
            let shade = lattice(tile as i32, 0, 0, 8);
            return if grout {
                CREAM
            } else {
                hsv(0.55 + 0.1 * shade, 0.75, 0.35 + 0.4 * shade)
            };
        }
        let cell = Vec2::new(p.x, p.z) / 0.062;
        let odd = (cell.x.floor() + cell.y.floor()).rem_euclid(2.0) < 1.0;
        if odd {
            light * (0.86 + 0.2 * vein)
        } else {
            dark * (0.7 + 0.9 * vein)
        }
    })
}

/// Dark stone with a line of text all around.
pub fn rim(text: &'static str) -> Pattern {
    let stone = Vec3::new(0.25, 0.22, 0.24);
    Arc::new(move |s: &Spot| {
        let letters: Vec<char> = text.chars().collect();
        let dots = letters.len() as f32 * font::ADVANCE as f32;
        let place = Vec2::new(s.uv.x * dots, (s.uv.y - 0.2) / 0.6 * font::HEIGHT as f32);
        if place.y >= 0.0 && font::dot(&letters, place.x as u32, place.y as u32) {
            return hsv(0.11, 0.45, 0.95);
        }
        stone * (0.8 + 0.5 * value_noise(s.position * 120.0, 13))
    })
}

/// Light veins that branch from a leaf's middle, darker green towards the border.
pub fn leaf() -> Pattern {
    let (light, dark) = (Vec3::new(0.60, 0.76, 0.30), Vec3::new(0.10, 0.36, 0.13));
    Arc::new(move |s: &Spot| {
        let across = (s.uv.x - 0.5).abs();
        let side = (s.uv.y * 9.0 + across * 4.0).fract();
        if across < 0.03 || (side < 0.14 && across < 0.44) {
            return light;
        }
        let mottle = value_noise(s.position * 60.0, 17);
        dark.lerp(light, 0.15 + 0.35 * mottle * (1.0 - across))
    })
}

/// A petal: yellow at its root, streaked, paler at the tip.
pub fn petal(hue: f32) -> Pattern {
    Arc::new(move |s: &Spot| {
        let root = (s.uv.y - 0.75).max(0.0) * 4.0;
        let streak = 0.12 * (s.uv.x * TAU * 5.0).cos();
        let body = hsv(hue, 0.55 + 0.35 * s.uv.y + streak, 0.97 - 0.1 * s.uv.y);
        body.lerp(hsv(0.13, 0.9, 0.9), root)
    })
}

/// White glaze with pressed flutes, hardly to be seen.
pub fn porcelain() -> Pattern {
    Arc::new(|s: &Spot| {
        let flute = 0.5 + 0.5 * (s.uv.x * TAU * 28.0).cos();
        let shade = if (0.30..0.80).contains(&s.uv.y) {
            0.955 + 0.035 * flute
        } else {
            0.985
        };
        Vec3::new(1.0, 0.995, 0.985) * shade
    })
}

/// Granite with moss where it faces up.
pub fn granite(top: f32) -> Pattern {
    Arc::new(move |s: &Spot| {
        let p = s.position;
        let grain = value_noise(p * 170.0, 31);
        let speck = if grain > 0.74 {
            0.30
        } else if grain < 0.22 {
            1.35
        } else {
            1.0
        };
        let rock = Vec3::new(0.52, 0.49, 0.48) * speck * (0.9 + 0.35 * fractal(p * 12.0, 5, 33));
        let moss = (p.y - top) * 14.0 + 1.3 * fractal(p * 22.0, 4, 35);
        if moss > 0.0 {
            Vec3::new(0.28, 0.40, 0.12) * (0.6 + 0.8 * value_noise(p * 230.0, 37))
        } else {
            rock
        }
    })
}
