//! What is written and drawn over a picture.

use std::time::{Duration, Instant};

use b2p::renderer::camera::Camera;

use super::keys::{HELP, SEQUENCE_HELP};
use super::painter::Picture;
use super::state::State;
use crate::font::{CHARACTER, glyph};
use crate::table::milliseconds;

/// Colours of letters, and of the box's edges.
const INK: u32 = 0xffffff;
const EDGES: u32 = 0xff8000;
/// Pixels around letters, before they are enlarged.
const MARGIN: u32 = 4;
/// The most steps of decoding that are listed.
const MOST_STEPS: usize = 12;
/// What takes less is not listed.
const SHORT: Duration = Duration::from_micros(500);

/// Pixels that can be written on.
pub struct Sheet<'a> {
    pub pixels: &'a mut [u32],
    pub size: [u32; 2],
}

/// Writes over a picture what `state` says is to be there. Letters are enlarged `zoom` times.
pub fn draw(state: &State, picture: Option<&Picture>, sheet: &mut Sheet, zoom: u32) {
    if let (Some(corners), Ok(camera)) = (state.clip.corners(), state.camera.camera(sheet.size)) {
        for [from, to] in edges(corners) {
            if let Some(ends) = on_picture(&camera, from, to) {
                sheet.line(ends, EDGES);
            }
        }
    }
    if let Some(clock) = &state.clock {
        sheet.time_line(clock.share(Instant::now()), zoom);
        let height = sheet.size[1].saturating_sub(time_line_height(zoom));
        return words(state, picture, &mut sheet.upper(height), zoom);
    }
    words(state, picture, sheet, zoom);
}

/// Pixels at the lower edge that the time line of a sequence takes.
pub fn time_line_height(zoom: u32) -> u32 {
    3 * MARGIN * zoom
}

fn words(state: &State, picture: Option<&Picture>, sheet: &mut Sheet, zoom: u32) {
    let mut upper = Vec::new();
    if state.times {
        upper.extend(times(state, picture));
    } else if state.busy || state.clock.is_some() && !state.is_running() {
        upper.push(state.line());
    }
    upper.extend(state.clip.describe());
    if state.help {
        let of_sequence = state.clock.iter().flat_map(|_| SEQUENCE_HELP);
        let rows: Vec<_> = of_sequence.chain(HELP).collect();
        let width = rows.iter().map(|(keys, _)| keys.len()).max().unwrap_or(0);
        upper.extend(rows.iter().map(|(keys, what)| format!("{keys:width$}  {what}")));
    }
    sheet.panel(&upper, false, zoom);
    if let Some(message) = &state.message {
        let columns = (sheet.size[0] / (CHARACTER * zoom)).saturating_sub(2).max(1);
        sheet.panel(&wrapped(message, columns as usize), true, zoom);
    }
}

/// What is shown and how long each stage took.
fn times(state: &State, picture: Option<&Picture>) -> Vec<String> {
    let mut lines = vec![state.line()];
    if let Some(scene) = &state.scene {
        let total: Duration = scene.steps.iter().map(|step| step.time).sum();
        lines.push(format!("decoded in {}", milliseconds(total)));
        let long = scene.steps.iter().filter(|step| step.time >= SHORT);
        let mut long: Vec<_> = long.collect();
        long.sort_by_key(|step| std::cmp::Reverse(step.time));
        let rows = long.iter().take(MOST_STEPS);
        lines.extend(rows.map(|step| format!("{:>10} {}", milliseconds(step.time), step.name)));
    }
    if let Some(picture) = picture {
        let stages = picture.stats.times;
        lines.push(format!(
            "{}x{} drawn in {}",
            picture.drawn[0],
            picture.drawn[1],
            milliseconds(picture.took)
        ));
        for (name, time) in [
            ("project", stages.project),
            ("bin", stages.bin),
            ("sort", stages.sort),
            ("blend", stages.blend),
        ] {
            lines.push(format!("{:>10} {name}", milliseconds(time)));
        }
    }
    lines
}

/// Lines of at most so many characters, broken between words where there are any.
fn wrapped(text: &str, columns: usize) -> Vec<String> {
    let mut lines = vec![String::new()];
    for word in text.split_whitespace() {
        let characters: Vec<char> = word.chars().collect();
        for (i, piece) in characters.chunks(columns).enumerate() {
            let line = lines.last_mut().filter(|line| {
                let length = line.chars().count();
                length == 0 || i == 0 && length + 1 + piece.len() <= columns
            });
            match line {
                Some(line) => {
                    if !line.is_empty() {
                        line.push(' ');
                    }
                    line.extend(piece);
                }
                None => lines.push(piece.iter().collect()),
            }
        }
    }
    lines
}

impl Sheet<'_> {
    /// The part above this row.
    fn upper(&mut self, height: u32) -> Sheet<'_> {
        Sheet {
            pixels: &mut self.pixels[..(height * self.size[0]) as usize],
            size: [self.size[0], height],
        }
    }

    /// The time line, of which a share has passed.
    fn time_line(&mut self, share: f64, zoom: u32) {
        let [width, height] = self.size;
        let top = height.saturating_sub(time_line_height(zoom));
        self.darken([0, top], [width, height]);
        let passed = (share * f64::from(width)) as u32;
        for y in (top + MARGIN * zoom..height.saturating_sub(MARGIN * zoom)).filter(|y| *y < height) {
            for x in 0..passed.min(width) {
                self.set([x, y], INK);
            }
        }
    }

    /// Lines of text on a darker ground, at the upper or the lower edge.
    fn panel(&mut self, lines: &[String], at_the_bottom: bool, zoom: u32) {
        let columns = lines.iter().map(|line| line.chars().count()).max().unwrap_or(0) as u32;
        if columns == 0 {
            return;
        }
        let side = |letters: u32, gap: u32| (letters * CHARACTER + gap + 2 * MARGIN) * zoom;
        let (width, height) = (side(columns, 0), side(lines.len() as u32, 2 * lines.len() as u32));
        let top = if at_the_bottom {
            self.size[1].saturating_sub(height)
        } else {
            0
        };
        self.darken([0, top], [width, top + height]);
        for (row, line) in lines.iter().enumerate() {
            let y = top + (MARGIN + row as u32 * (CHARACTER + 2) + 1) * zoom;
            for (column, character) in line.chars().enumerate() {
                let x = (MARGIN + column as u32 * CHARACTER) * zoom;
                self.letter(character, [x, y], zoom);
            }
        }
    }

    fn darken(&mut self, [left, top]: [u32; 2], [right, bottom]: [u32; 2]) {
        let [width, height] = self.size;
        for y in top..bottom.min(height) {
            let row = &mut self.pixels[(y * width) as usize..][..width as usize];
            for pixel in &mut row[left.min(width) as usize..right.min(width) as usize] {
                *pixel = *pixel >> 2 & 0x3f3f3f;
            }
        }
    }

    fn letter(&mut self, character: char, [left, top]: [u32; 2], zoom: u32) {
        let rows = glyph(character);
        for y in 0..CHARACTER * zoom {
            for x in 0..CHARACTER * zoom {
                if rows[(y / zoom) as usize] >> (x / zoom) & 1 == 1 {
                    self.set([left + x, top + y], INK);
                }
            }
        }
    }

    fn set(&mut self, [x, y]: [u32; 2], colour: u32) {
        if x < self.size[0] && y < self.size[1] {
            self.pixels[(y * self.size[0] + x) as usize] = colour;
        }
    }

    /// A straight line between two points of the picture.
    fn line(&mut self, [from, to]: [[f64; 2]; 2], colour: u32) {
        let length = (to[0] - from[0]).abs().max((to[1] - from[1]).abs()).ceil().max(1.0);
        for i in 0..=length as u32 {
            let share = f64::from(i) / length;
            let at = [0, 1].map(|k| (from[k] + share * (to[k] - from[k])).floor());
            if at.iter().all(|x| *x >= 0.0) {
                self.set(at.map(|x| x as u32), colour);
            }
        }
    }
}

/// The twelve edges of a box.
fn edges([low, high]: [[f32; 3]; 2]) -> impl Iterator<Item = [[f64; 3]; 2]> {
    let corner = move |i: u32| [0, 1, 2].map(|k| f64::from(if i >> k & 1 == 1 { high[k] } else { low[k] }));
    let from_each = move |i: u32| {
        let axes = (0..3).filter(move |axis| i >> axis & 1 == 0);
        axes.map(move |axis| [corner(i), corner(i | 1 << axis)])
    };
    (0..8).flat_map(from_each)
}

/// Where an edge is in the picture, as far as it is in front of the eye and in the picture.
fn on_picture(camera: &Camera, from: [f64; 3], to: [f64; 3]) -> Option<[[f64; 2]; 2]> {
    let [a, b] = [from, to].map(|point| camera.pose.transform_point3(point.into()).to_array());
    // Inside are all points for which each of these is positive: in front, and between the borders.
    let borders = |p: [f64; 3]| {
        let [x, y] = [camera.fx * p[0] + camera.cx * p[2], camera.fy * p[1] + camera.cy * p[2]];
        let [right, bottom] = [camera.width, camera.height].map(|side| f64::from(side) * p[2]);
        [p[2] - camera.near, x, right - x, y, bottom - y]
    };
    let (mut first, mut last) = (0.0f64, 1.0f64);
    for (at_a, at_b) in borders(a).into_iter().zip(borders(b)) {
        match (at_a < 0.0, at_b < 0.0) {
            (true, true) => return None,
            (true, false) => first = first.max(at_a / (at_a - at_b)),
            (false, true) => last = last.min(at_a / (at_a - at_b)),
            (false, false) => {}
        }
    }
    let point = |share: f64| {
        let p: [f64; 3] = std::array::from_fn(|k| a[k] + share * (b[k] - a[k]));
        [camera.fx * p[0] / p[2] + camera.cx, camera.fy * p[1] / p[2] + camera.cy]
    };
    (first < last).then(|| [point(first), point(last)])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn letters_are_written_within_the_picture_only() {
        let mut pixels = vec![0x808080; 20 * 10];
        let mut sheet = Sheet {
            pixels: &mut pixels,
            size: [20, 10],
        };
        sheet.panel(&["a long line of words".into(), "more".into(), "more".into()], true, 1);
        sheet.panel(&[], false, 1);
        assert!(pixels.contains(&INK) && pixels.contains(&0x202020));
    }

    #[test]
    fn the_time_line_is_as_long_as_the_share_that_has_passed() {
        for (share, passed) in [(0.0, 0), (0.5, 20), (1.0, 40)] {
            let mut pixels = vec![0x808080; 40 * 30];
            let mut sheet = Sheet {
                pixels: &mut pixels,
                size: [40, 30],
            };
            sheet.time_line(share, 1);
            let row = &pixels[40 * (30 - 6)..][..40];
            assert_eq!(row.iter().filter(|pixel| **pixel == INK).count(), passed);
            assert!(pixels[..40 * 18].iter().all(|pixel| *pixel == 0x808080));
        }
        let mut low = [0; 8];
        let mut sheet = Sheet {
            pixels: &mut low,
            size: [4, 2],
        };
        sheet.time_line(1.0, 2);
        assert!(sheet.upper(0).pixels.is_empty());
    }

    #[test]
    fn lines_break_between_words_and_within_those_that_are_too_long() {
        assert_eq!(wrapped("one two three", 7), ["one two", "three"]);
        assert_eq!(wrapped("abcdefgh ij", 3), ["abc", "def", "gh", "ij"]);
        assert_eq!(wrapped("", 5), [""]);
    }

    #[test]
    fn a_box_has_twelve_edges_that_end_at_the_borders_of_the_picture() {
        let all: Vec<_> = edges([[-1.0; 3], [1.0; 3]]).collect();
        assert_eq!(all.len(), 12);
        assert!(all.iter().all(|[a, b]| (0..3).filter(|&k| a[k] != b[k]).count() == 1));
        for distance in [0.5, 1.2, 3.0, 9.0] {
            let camera = Camera::orbit(30.0, 20.0, distance, 45.0, 200, 100).unwrap();
            let ends = all.iter().filter_map(|[a, b]| on_picture(&camera, *a, *b));
            for [x, y] in ends.flatten() {
                assert!(
                    (-1e-6..=200.000001).contains(&x) && (-1e-6..=100.000001).contains(&y),
                    "{distance}: {x}, {y}"
                );
            }
        }
        let far = Camera::orbit(30.0, 20.0, 9.0, 45.0, 200, 100).unwrap();
        assert!(all.iter().all(|[a, b]| on_picture(&far, *a, *b).is_some()));
        assert!(on_picture(&far, [0.0, 0.0, 50.0], [1.0, 0.0, 50.0]).is_none());
    }
}
