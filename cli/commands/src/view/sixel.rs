//! Pictures as sixels, which some terminals show: six rows at a time, one colour after the other.

use color_quant::NeuQuant;

/// Colours of a picture; terminals have at least so many.
const COLOURS: usize = 256;
/// Pixels that are looked at to choose the colours: fewer choose badly, of more only one in so many is taken.
const SAMPLES: usize = 1 << 15;
/// Rows of pixels that one character has.
const ROWS: usize = 6;

/// A picture of pixels 0x00RRGGBB, row by row, as what a terminal is to be sent.
pub fn encode(pixels: &[u32], width: usize) -> String {
    let height = pixels.len() / width.max(1);
    let rgba: Vec<u8> = pixels
        .iter()
        .flat_map(|p| [(p >> 16) as u8, (p >> 8) as u8, *p as u8, 255])
        .collect();
    // The chooser needs some pixels to choose from.
    let mut sample = rgba.clone();
    while !sample.is_empty() && sample.len() < 4 * SAMPLES {
        sample.extend_from_within(..);
    }
    if sample.is_empty() {
        return String::new();
    }
    // The chooser takes 1 to 30.
    let one_in = (sample.len() / 4 / SAMPLES).clamp(1, 30) as i32;
    let palette = NeuQuant::new(one_in, COLOURS, &sample);
    let indices: Vec<u8> = rgba
        .chunks_exact(4)
        .map(|colour| palette.index_of(colour) as u8)
        .collect();
    let mut text = format!("\x1bP0;1;0q\"1;1;{width};{height}");
    let colours = palette.color_map_rgb();
    for (i, colour) in colours.chunks_exact(3).enumerate() {
        let percent = |c: u8| (u32::from(c) * 100 + 127) / 255;
        let [r, g, b] = [0, 1, 2].map(|k| percent(colour[k]));
        text += &format!("#{i};2;{r};{g};{b}");
    }
    for band in indices.chunks(ROWS * width) {
        encode_band(band, width, &mut text);
    }
    text + "\x1b\\"
}

/// At most six rows: for each colour that is in them, which pixels have it.
fn encode_band(band: &[u8], width: usize, text: &mut String) {
    let mut masks = vec![[0u8; COLOURS]; width];
    let mut used = [false; COLOURS];
    for (y, row) in band.chunks(width).enumerate() {
        for (mask, &colour) in masks.iter_mut().zip(row) {
            mask[usize::from(colour)] |= 1 << y;
            used[usize::from(colour)] = true;
        }
    }
    for colour in (0..COLOURS).filter(|&colour| used[colour]) {
        *text += &format!("#{colour}");
        let mut column = 0;
        while column < width {
            let mask = masks[column][colour];
            let run = masks[column..].iter().take_while(|other| other[colour] == mask).count();
            let sixel = char::from(b'?' + mask);
            match run {
                0..=3 => text.extend(std::iter::repeat_n(sixel, run)),
                _ => *text += &format!("!{run}{sixel}"),
            }
            column += run;
        }
        // Back to the start of the line: the next colour is put over it.
        text.push('$');
    }
    text.push('-');
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A plain decoder of what `encode` writes.
    fn decode(text: &str, width: usize, height: usize) -> Vec<u32> {
        let body = text
            .strip_prefix("\x1bP0;1;0q\"")
            .unwrap()
            .strip_suffix("\x1b\\")
            .unwrap();
        let (mut palette, mut pixels) = (vec![0u32; COLOURS], vec![0; width * height]);
        let (mut colour, mut x, mut y) = (0, 0, 0);
        let mut rest = &body[body.find('#').unwrap()..];
        while let Some(first) = rest.chars().next() {
            let number = |text: &str| text.chars().take_while(|c| c.is_ascii_digit() || *c == ';').count();
            rest = &rest[1..];
            match first {
                '#' => {
                    let length = number(rest);
                    let numbers: Vec<u32> = rest[..length].split(';').map(|n| n.parse().unwrap()).collect();
                    colour = numbers[0] as usize;
                    if let [_, 2, r, g, b] = numbers[..] {
                        palette[colour] = [r, g, b].iter().fold(0, |all, c| (all << 8) | ((c * 255 + 50) / 100));
                    }
                    rest = &rest[length..];
                }
                '$' => x = 0,
                '-' => (x, y) = (0, y + ROWS),
                _ => {
                    let length = if first == '!' { number(rest) } else { 0 };
                    let run = if first == '!' {
                        rest[..length].parse().unwrap()
                    } else {
                        1
                    };
                    let sixel = if first == '!' {
                        rest.as_bytes()[length]
                    } else {
                        first as u8
                    };
                    rest = &rest[length + usize::from(first == '!')..];
                    for column in x..x + run {
                        for row in (0..ROWS).filter(|row| (sixel - b'?') >> row & 1 == 1) {
                            pixels[(y + row) * width + column] = palette[colour];
                        }
                    }
                    x += run;
                }
            }
        }
        pixels
    }

    #[test]
    fn a_picture_comes_back_nearly_as_it_was() {
        let (width, height) = (50, 20);
        let pixels: Vec<u32> = (0..width * height)
            .map(|i| ((i % width) * 5) as u32 | (((i / width) * 12) as u32) << 8 | 0x400000)
            .collect();
        let found = decode(&encode(&pixels, width), width, height);
        let channels = |p: &u32| [0, 8, 16].map(|shift| (p >> shift & 255) as i32);
        let pairs = pixels.iter().flat_map(channels).zip(found.iter().flat_map(channels));
        let errors: Vec<i32> = pairs.map(|(a, b)| (a - b).abs()).collect();
        let mean = errors.iter().sum::<i32>() / errors.len() as i32;
        let most = errors.iter().max().copied().unwrap_or_default();
        assert!(mean < 8 && most < 48, "{mean}, {most}");
    }

    #[test]
    fn the_smallest_pictures_are_written_too() {
        assert_eq!(encode(&[], 0), "");
        assert_eq!(decode(&encode(&[0xffffff], 1), 1, 1), [0xffffff]);
    }
}
