use super::*;
use crate::splats::tests::{read_back, sample, written};
use crate::splats::{Format, Options};

#[test]
fn the_words_are_those_of_the_format() {
    assert_eq!(
        level(1.0, 11) << 21 | level(0.5, 10) << 11 | level(0.0, 11),
        0xffe0_0000 | 512 << 11
    );
    // The identity: the largest component is w, the others are the middle of their range.
    assert_eq!(pack_rotation([1.0, 0.0, 0.0, 0.0]), 512 << 20 | 512 << 10 | 512);
    assert_eq!(pack_rotation([0.0, 0.0, -1.0, 0.0]) >> 30, 2);
    assert_eq!(
        (pack_harmonic(0.0), pack_harmonic(-4.0), pack_harmonic(9.0)),
        (128, 0, 255)
    );
    assert_eq!((unpack_harmonic(0.0), unpack_harmonic(255.0)), (-4.0, 4.0));
}

#[test]
fn files_without_bounds_of_colours_have_plain_colours() {
    let bytes = written(&sample(3, 0), Format::CompressedPly);
    let header = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let text = String::from_utf8(bytes[..header].to_vec()).unwrap();
    let is_colour =
        |line: &&str| line.starts_with("property float") && ["_r", "_g", "_b"].iter().any(|c| line.ends_with(c));
    let changed: String = text
        .lines()
        .filter(|line| !is_colour(line))
        .map(|line| format!("{line}\n"))
        .collect();
    assert_eq!(changed.lines().count() + 6, text.lines().count());
    let mut file = changed.into_bytes();
    file.extend(&bytes[header..header + 48]);
    file.extend(&bytes[header + 72..]);
    let colours = read_back(&file, Format::CompressedPly, [0.0; 3]).gaussians.colour;
    let words = &bytes[header + 72..];
    for (i, colour) in colours.iter().enumerate() {
        let bytes = &words[16 * i + 12..][..4];
        let expected = [bytes[3], bytes[2], bytes[1]].map(|b| f32::from(b) / 255.0);
        assert_eq!(*colour, expected);
    }
}

#[test]
fn elements_that_do_not_fit_each_other_are_errors() {
    let bytes = written(&sample(3, 3), Format::CompressedPly);
    let text = String::from_utf8_lossy(&bytes).into_owned();
    let refused = |from: &str, to: &str| {
        let at = text.find(from).unwrap();
        let mut changed = bytes[..at].to_vec();
        changed.extend(to.as_bytes());
        changed.extend(&bytes[at + from.len()..]);
        changed.extend([0; 4096]);
        let result = crate::splats::read(&changed, Format::CompressedPly, &Options::default(), &Limits::default());
        result.unwrap_err().to_string()
    };
    assert!(refused("element chunk 1", "element chunk 2").contains("expected 1 for 3 Gaussians"));
    assert!(refused("element sh 3", "element sh 2").contains("count of element sh is 2, expected 3"));
    assert!(refused("property uchar f_rest_8\n", "").contains("properties of element sh is 8"));
    assert!(refused("element vertex 3", "element vertex 4000000000").contains("limit"));
    assert!(refused("max_scale_y", "max_scale_w").contains("max_scale_y"));
}
