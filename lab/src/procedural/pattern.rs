//! What surfaces are painted with. Sizes are lengths along the surface, or in space where a pattern is solid.

use std::f32::consts::TAU;
use std::sync::Arc;

use glam::{Vec2, Vec3};

use super::font;
use super::patch::{Pattern, Spot};
use super::rng::{Rng, fractal, lattice, value_noise};

fn pattern(f: impl Fn(&Spot) -> Vec3 + Send + Sync + 'static) -> Pattern {
    Arc::new(f)
}

/// One colour.
pub fn plain(colour: Vec3) -> Pattern {
    pattern(move |_| colour)
}

/// Squares of two colours.
pub fn checker(size: f32, a: Vec3, b: Vec3) -> Pattern {
    pattern(move |s| {
        let cell = (s.st / size).floor();
        if (cell.x + cell.y).rem_euclid(2.0) < 1.0 { a } else { b }
    })
}

/// Stripes of equal width in turn, `angle` radians from upright.
pub fn stripes(width: f32, angle: f32, colours: Vec<Vec3>) -> Pattern {
    let across = Vec2::from_angle(angle);
    pattern(move |s| {
        let stripe = (s.st.dot(across) / width).floor() as i64;
        colours[stripe.rem_euclid(colours.len() as i64) as usize]
    })
}

/// From the first colour to the last along a direction in space, once between positions −1 and 1.
pub fn gradient(along: Vec3, colours: Vec<Vec3>) -> Pattern {
    pattern(move |s| ramp(&colours, 0.5 + 0.5 * s.position.dot(along)))
}

/// Between the colours of a list, evenly spaced over `[0, 1]`.
fn ramp(colours: &[Vec3], t: f32) -> Vec3 {
    let last = colours.len() - 1;
    if last == 0 {
        return colours[0];
    }
    let x = t.clamp(0.0, 1.0) * last as f32;
    let i = (x as usize).min(last - 1);
    colours[i].lerp(colours[i + 1], x - i as f32)
}

/// Soft solid clouds, with detail down to `size / 32`.
pub fn clouds(size: f32, colours: Vec<Vec3>, seed: u32) -> Pattern {
    pattern(move |s| {
        let n = fractal(s.position / size, 6, seed);
        ramp(&colours, 0.5 + 0.6 * n)
    })
}

/// Solid veins: thin dark lines through clouds.
pub fn marble(size: f32, colours: Vec<Vec3>, seed: u32) -> Pattern {
    pattern(move |s| {
        let p = s.position / size;
        let turbulence = fractal(p, 6, seed);
        let wave = (TAU * (0.6 * (p.x + 0.7 * p.y - 0.4 * p.z) + 1.6 * turbulence)).sin();
        ramp(&colours, wave.abs().powf(0.4))
    })
}

/// Solid year rings around an axis through the origin that leans a little.
pub fn wood(ring: f32, light: Vec3, dark: Vec3, seed: u32) -> Pattern {
    pattern(move |s| {
        let p = s.position;
        let lean = Vec2::new(p.x + 0.15 * p.y, p.z - 0.1 * p.y);
        let wobble = 0.8 * fractal(p / (ring * 8.0), 3, seed);
        let t = (lean.length() / ring + 2.0 * wobble).rem_euclid(1.0);
        let fibre = value_noise(Vec3::new(p.x, p.y * 0.06, p.z) / (ring * 0.12), seed);
        light.lerp(dark, 0.75 * t * t * t + 0.25 * fibre)
    })
}

/// Bricks in running bond with mortar between; each brick a little different.
pub fn bricks(length: f32, brick: Vec3, mortar: Vec3, seed: u32) -> Pattern {
    pattern(move |s| {
        let y = s.st.y / (0.4 * length);
        let row = y.floor();
        let x = s.st.x / length + 0.5 * row.rem_euclid(2.0);
        let (fx, fy) = (x - x.floor(), y - row);
        if fx < 0.05 || fy < 0.125 {
            return mortar;
        }
        let tone = 0.75 + 0.5 * lattice(x.floor() as i32, row as i32, 0, seed);
        let grain = 0.9 + 0.2 * value_noise(s.position * (40.0 / length), seed);
        brick * tone * grain
    })
}

/// Round dots in a staggered grid.
pub fn dots(spacing: f32, dot: Vec3, ground: Vec3) -> Pattern {
    pattern(move |s| {
        let y = s.st.y / spacing;
        let shift = 0.5 * y.floor().rem_euclid(2.0);
        let cell = Vec2::new(s.st.x / spacing + shift, y);
        let off = cell - cell.floor() - Vec2::splat(0.5);
        if off.length() < 0.3 { dot } else { ground }
    })
}

/// Tiles whose colours are drawn from a list by chance.
pub fn mosaic(size: f32, colours: Vec<Vec3>, grout: Vec3, seed: u32) -> Pattern {
    pattern(move |s| {
        let cell = s.st / size;
        let [x, y] = cell.floor().as_ivec2().to_array();
        let f = cell - cell.floor();
        if f.min_element() < 0.12 {
            return grout;
        }
        let which = lattice(x, y, 0, seed) * colours.len() as f32;
        colours[which as usize] * (0.85 + 0.3 * lattice(x, y, 1, seed))
    })
}

/// Threads over and under each other.
pub fn weave(size: f32, warp: Vec3, weft: Vec3) -> Pattern {
    pattern(move |s| {
        let cell = s.st / size;
        let f = cell - cell.floor() - Vec2::splat(0.5);
        let over = (cell.floor().x + cell.floor().y).rem_euclid(2.0) < 1.0;
        let (colour, off) = if over { (warp, f.x) } else { (weft, f.y) };
        colour * (1.0 - 1.6 * off * off)
    })
}

/// Specks of one colour on another, solid.
pub fn speckle(size: f32, speck: Vec3, ground: Vec3, seed: u32) -> Pattern {
    pattern(move |s| {
        let n = value_noise(s.position / size, seed);
        let tint = 0.94 + 0.12 * value_noise(s.position / (size * 6.0), seed + 1);
        if n > 0.72 { speck } else { ground * tint }
    })
}

/// Rows of scales.
pub fn scales(size: f32, colours: Vec<Vec3>) -> Pattern {
    pattern(move |s| {
        let y = s.st.y / (0.5 * size);
        for row in [y.floor(), y.floor() - 1.0] {
            let shift = 0.5 * row.rem_euclid(2.0);
            let x = s.st.x / size + shift;
            let centre = Vec2::new(x.floor() + 0.5, row);
            let r = Vec2::new(x - centre.x, 0.5 * (y - centre.y)).length() / 0.56;
            if r < 1.0 {
                return ramp(&colours, r * r);
            }
        }
        colours[0]
    })
}

/// Lines of text, from the patch's upper left corner, in dots of a size; repeated downwards.
pub fn text(lines: &[&str], dot: f32, ink: Vec3, paper: Vec3) -> Pattern {
    let lines: Vec<Vec<char>> = lines.iter().map(|l| l.chars().collect()).collect();
    pattern(move |s| {
        let (x, y) = ((s.st.x / dot) as u32, (s.st.y / dot) as u32);
        let pitch = font::HEIGHT + 3;
        let line = &lines[(y / pitch) as usize % lines.len()];
        let inside = x >= 3 && font::dot(line, x - 3, (y % pitch).wrapping_sub(2));
        if inside { ink } else { paper }
    })
}

/// Three to five colours that go together.
pub fn palette(rng: &mut Rng) -> Vec<Vec3> {
    let hue = rng.unit();
    let mode = rng.below(9);
    let count = 3 + rng.below(3);
    (0..count)
        .map(|i| {
            let t = i as f32 / (count - 1) as f32;
            let near = hue + rng.range(-0.06, 0.06);
            match mode {
                0 | 7 => hsv(rng.unit(), rng.range(0.8, 1.0), rng.range(0.75, 1.0)),
                1 => hsv(near, rng.range(0.2, 0.8), rng.range(0.03, 0.3)),
                2 => hsv(near, rng.range(0.0, 0.05), rng.range(0.86, 1.0)),
                3 => hsv(rng.unit(), rng.range(0.15, 0.4), rng.range(0.75, 0.95)),
                4 => hsv(0.04 + 0.1 * rng.unit(), rng.range(0.3, 0.7), 0.25 + 0.6 * t),
                5 => Vec3::splat((0.02 + 0.96 * t).clamp(0.0, 1.0)),
                _ => hsv(near + 0.5 * (i % 2) as f32, 0.5 + 0.4 * rng.unit(), 0.3 + 0.65 * t),
            }
        })
        .collect()
}

/// A colour from hue, saturation and value, all in turns of 1.
pub fn hsv(hue: f32, saturation: f32, value: f32) -> Vec3 {
    let wave = |shift: f32| {
        let x = (hue + shift).rem_euclid(1.0) * 6.0;
        ((x - 3.0).abs() - 1.0).clamp(0.0, 1.0)
    };
    let pure = Vec3::new(wave(0.0), wave(2.0 / 3.0), wave(1.0 / 3.0));
    value * Vec3::ONE.lerp(pure, saturation)
}

/// A pattern by chance, with details of about `size`.
pub fn any(rng: &mut Rng, size: f32) -> Pattern {
    let colours = palette(rng);
    let (a, b, c) = (colours[0], colours[1], colours[2]);
    let seed = rng.bits() as u32;
    match rng.below(15) {
        0 => checker(size, a, b),
        1 => stripes(size, rng.range(0.0, TAU), colours),
        2 => gradient(rng.direction(), colours),
        3 => clouds(size * 6.0, colours, seed),
        4 => marble(size * 10.0, colours, seed),
        5 => wood(size, a, b, seed),
        6 => bricks(size * 2.5, a, b, seed),
        7 => dots(size, a, b),
        8 => mosaic(size, colours, c, seed),
        9 => weave(size, a, b),
        10 => speckle(size, a, b, seed),
        11 => scales(size, colours),
        12 => plain(a),
        _ => {
            let lines: Vec<String> = (0..7).map(|_| words(rng)).collect();
            let lines: Vec<&str> = lines.iter().map(String::as_str).collect();
            text(
                &lines,
                size * 0.25,
                a,
                if a.distance(b) > 0.3 { b } else { Vec3::ONE - a },
            )
        }
    }
}

/// A line of made-up words, numbers and signs.
fn words(rng: &mut Rng) -> String {
    let mut line = String::new();
    while line.len() < 60 {
        for _ in 0..2 + rng.below(7) {
            let letter = match rng.below(12) {
                0 => b'A' + rng.below(26) as u8,
                1 => b'!' + rng.below(31) as u8,
                _ => b'a' + rng.below(26) as u8,
            };
            line.push(letter.into());
        }
        line.push(' ');
    }
    line
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(pattern: &Pattern, x: f32, y: f32) -> Vec3 {
        pattern(&Spot {
            uv: Vec2::new(x, y),
            st: Vec2::new(x, y),
            position: Vec3::new(x, y, 0.3),
        })
    }

    #[test]
    fn every_pattern_gives_colours_near_the_unit_cube_everywhere() {
        let mut rng = Rng::new(9);
        for _ in 0..60 {
            let pattern = any(&mut rng, 0.03);
            for i in 0..200 {
                let colour = at(&pattern, i as f32 * 0.013 - 0.4, i as f32 * 0.0071);
                assert!(colour.is_finite());
                assert!(colour.min_element() >= 0.0 && colour.max_element() < 1.6, "{colour}");
            }
        }
    }

    #[test]
    fn a_checkers_neighbours_differ_and_diagonals_agree() {
        let p = checker(1.0, Vec3::ZERO, Vec3::ONE);
        assert_ne!(at(&p, 0.5, 0.5), at(&p, 1.5, 0.5));
        assert_eq!(at(&p, 0.5, 0.5), at(&p, 1.5, 1.5));
        assert_ne!(at(&p, 0.5, 0.5), at(&p, -0.5, 0.5));
    }

    #[test]
    fn written_text_can_be_read_back() {
        let p = text(&["H"], 1.0, Vec3::ZERO, Vec3::ONE);
        let row: String = (0..11)
            .map(|x| {
                if at(&p, x as f32 + 0.5, 2.5) == Vec3::ZERO {
                    '#'
                } else {
                    '.'
                }
            })
            .collect();
        assert_eq!(row, "...#...#...");
    }

    #[test]
    fn hues_are_where_they_should_be() {
        assert_eq!(hsv(0.0, 1.0, 1.0), Vec3::X);
        assert!(hsv(1.0 / 3.0, 1.0, 1.0).distance(Vec3::Y) < 1e-5);
        assert!(hsv(2.0 / 3.0, 1.0, 0.5).distance(0.5 * Vec3::Z) < 1e-5);
    }
}
