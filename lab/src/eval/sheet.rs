//! The contact sheet: a row of pictures for every method, the truth first.

use super::picture::Picture;
use crate::procedural::font;

/// Pixels between pictures and around them.
const GAP: usize = 8;
const PAPER: [u8; 3] = [238, 238, 236];
const INK: [u8; 3] = [20, 20, 24];

/// One row: what stands above it, and its pictures.
pub struct SheetRow<'a> {
    /// What stands above the pictures.
    pub label: String,
    /// The pictures, all as large as the truth's.
    pub pictures: Vec<&'a Picture>,
}

/// Puts rows below each other; of every picture only `crop` (first column, first row, width, height) is shown, pixel
/// for pixel.
///
/// # Panics
/// If `crop` reaches beyond a picture.
pub fn contact_sheet(rows: &[SheetRow], crop: [usize; 4]) -> Picture {
    let [_, _, across, down] = crop;
    let columns = rows.iter().map(|r| r.pictures.len()).max().unwrap_or(0);
    let width = (GAP + columns * (across + GAP)).max(320);
    let scales: Vec<usize> = rows.iter().map(|r| text_scale(&r.label, width)).collect();
    let strip = |scale: usize| font::HEIGHT as usize * scale + GAP;
    let height: usize = scales.iter().map(|&s| strip(s) + down + GAP).sum();
    let mut sheet = Picture::new(width, GAP + height, PAPER);
    let mut top = GAP;
    for (row, scale) in rows.iter().zip(scales) {
        write(&mut sheet, &row.label, GAP, top, scale);
        top += strip(scale);
        for (i, picture) in row.pictures.iter().enumerate() {
            paste(&mut sheet, picture, crop, GAP + i * (across + GAP), top);
        }
        top += down + GAP;
    }
    sheet
}

/// Two pixels a dot where the text then fits, else one.
fn text_scale(text: &str, width: usize) -> usize {
    let dots = font::line_width(text.chars().count()) as usize;
    if 2 * dots + 2 * GAP <= width { 2 } else { 1 }
}

/// Writes a line of text; what does not fit is cut off.
fn write(sheet: &mut Picture, text: &str, left: usize, top: usize, scale: usize) {
    let text: Vec<char> = text.chars().collect();
    let dots = font::line_width(text.len()) as usize;
    let right = (left + dots * scale).min(sheet.width);
    for y in 0..font::HEIGHT as usize * scale {
        for x in left..right {
            if font::dot(&text, ((x - left) / scale) as u32, (y / scale) as u32) {
                sheet.rgb[(top + y) * sheet.width + x] = INK;
            }
        }
    }
}

fn paste(sheet: &mut Picture, picture: &Picture, crop: [usize; 4], left: usize, top: usize) {
    let [x, y, across, down] = crop;
    for row in 0..down {
        let from = (y + row) * picture.width + x;
        let to = (top + row) * sheet.width + left;
        sheet.rgb[to..to + across].copy_from_slice(&picture.rgb[from..from + across]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_stand_under_their_label_cropped_and_side_by_side() {
        let (a, b) = (Picture::new(40, 30, [1, 2, 3]), Picture::new(40, 30, [200, 0, 0]));
        let row = SheetRow {
            label: "I".into(),
            pictures: vec![&a, &b],
        };
        let sheet = contact_sheet(&[row], [5, 5, 20, 10]);
        let top = GAP + 14 + GAP;
        assert_eq!(sheet.height, top + 10 + GAP);
        assert_eq!(sheet.at(GAP, top), [1, 2, 3]);
        assert_eq!(sheet.at(GAP + 20, top), PAPER);
        assert_eq!(sheet.at(2 * GAP + 20, top + 9), [200, 0, 0]);
        assert_eq!(sheet.at(GAP + 4, GAP + 6), INK);
    }

    #[test]
    fn a_long_label_is_written_small_and_cut_off() {
        let row = SheetRow {
            label: "M".repeat(200),
            pictures: Vec::new(),
        };
        let sheet = contact_sheet(&[row], [0, 0, 1, 1]);
        assert_eq!(sheet.width, 320);
        assert_eq!(sheet.height, GAP + 7 + GAP + 1 + GAP);
    }
}
