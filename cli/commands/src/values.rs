//! The values of arguments, as they are written.

use std::num::NonZeroU8;
use std::ops::RangeInclusive;

use b2p::encoder::Residual;
use b2p::encoder::transform::{GeometryTarget, Outline, QualityTarget, Tune};
use b2p::latents::Steps;
use b2p::renderer::{Background, Effect, EffectMode};

/// A number of bytes, with or without K, M, G or T for powers of 1024.
pub fn bytes(text: &str) -> Result<u64, String> {
    let expected = "expected bytes such as 500M or 4G";
    let digits = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let power = match text[digits.len()..].to_ascii_uppercase().as_str() {
        "" => 0,
        "K" => 1,
        "M" => 2,
        "G" => 3,
        "T" => 4,
        _ => return Err(expected.into()),
    };
    let number: u64 = digits.parse().map_err(|_| expected)?;
    number.checked_mul(1 << (10 * power)).ok_or_else(|| expected.into())
}

/// A number of bits, with or without k, M or G for powers of 1000.
pub fn bits(text: &str) -> Result<f64, String> {
    let expected = "expected bits such as 5M or 800k";
    let digits = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let scale = match text[digits.len()..].to_ascii_uppercase().as_str() {
        "" => 1.0,
        "K" => 1e3,
        "M" => 1e6,
        "G" => 1e9,
        _ => return Err(expected.into()),
    };
    match digits.parse::<f64>() {
        Ok(number) if number > 0.0 && number.is_finite() => Ok(number * scale),
        _ => Err(expected.into()),
    }
}

/// Frames per second as ticks per second and per frame: a whole number, a fraction, or up to three decimals.
pub fn frame_rate(text: &str) -> Result<(u32, u32), String> {
    let expected = "expected frames per second such as 30, 29.97 or 30000/1001";
    let above_0 = |text: &str| text.parse::<u32>().ok().filter(|n| *n > 0);
    if let Some((ticks, duration)) = text.split_once('/') {
        return above_0(ticks).zip(above_0(duration)).ok_or_else(|| expected.into());
    }
    if let Some(whole) = above_0(text) {
        return Ok((whole, 1));
    }
    match text.parse::<f64>() {
        Ok(rate) if (0.001..=1e6).contains(&rate) => Ok(((rate * 1000.0).round() as u32, 1000)),
        _ => Err(expected.into()),
    }
}

/// Frames from A to before B.
pub fn frames(text: &str) -> Result<std::ops::Range<u64>, String> {
    let expected = "expected frames such as 0..64, the last one not included";
    let (first, end) = text.split_once("..").ok_or(expected)?;
    match (first.parse(), end.parse()) {
        (Ok(first), Ok(end)) if first < end => Ok(first..end),
        _ => Err(expected.into()),
    }
}

pub fn levels(text: &str) -> Result<RangeInclusive<u8>, String> {
    let expected = "expected two levels such as 7..9";
    let (first, last) = text.split_once("..").ok_or(expected)?;
    let number = |t: &str| t.trim_start_matches('=').parse::<u8>().map_err(|_| expected);
    let (first, last) = (number(first)?, number(last)?);
    if first > last {
        return Err(format!("level {first} comes after level {last}"));
    }
    Ok(first..=last)
}

pub fn price(text: &str) -> Result<f32, String> {
    match text.parse() {
        Ok(price) if (0.0..=100.0).contains(&price) => Ok(price),
        _ => Err("expected a number from 0 to 100".into()),
    }
}

pub fn step(text: &str) -> Result<QualityTarget, String> {
    let size = |text: &str| match text.parse() {
        Ok(step) if (0.5..=1000.0).contains(&step) => Ok(step),
        _ => Err("expected one or two numbers from 0.5 to 1000 such as 16 or 16,24"),
    };
    Ok(match text.split_once(',') {
        None => QualityTarget::Step(size(text)?),
        Some((luma, chroma)) => QualityTarget::Steps {
            luma: size(luma)?,
            chroma: size(chroma)?,
        },
    })
}

pub fn geometry(text: &str) -> Result<GeometryTarget, String> {
    match text {
        "exact" => return Ok(GeometryTarget::Exact),
        "visual" => return Ok(GeometryTarget::Visual),
        _ => {}
    }
    match text.parse() {
        Ok(lambda) if (0.0..=100.0).contains(&lambda) => Ok(GeometryTarget::Lambda(lambda)),
        _ => Err("expected exact, visual, or a number from 0 to 100".into()),
    }
}

pub fn tune(text: &str) -> Result<Tune, String> {
    match text {
        "visual" => Ok(Tune::Visual),
        "psnr" => Ok(Tune::Psnr),
        _ => Err("expected visual or psnr".into()),
    }
}

pub fn outline(text: &str) -> Result<Outline, String> {
    match text {
        "surface" => Ok(Outline::Surface),
        "cloud" => Ok(Outline::Cloud),
        _ => Err("expected surface or cloud".into()),
    }
}

pub fn per_voxel(text: &str) -> Result<usize, String> {
    match text {
        "1" => Ok(1),
        "4" => Ok(4),
        "8" => Ok(8),
        _ => Err("expected 1, 4 or 8".into()),
    }
}

pub fn bits_per_point(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(bits) if bits > 0.0 && f64::is_finite(bits) => Ok(bits),
        _ => Err("expected a number above 0 such as 0.3".into()),
    }
}

pub fn residual(text: &str) -> Result<Residual, String> {
    match text {
        "none" => return Ok(Residual::None),
        "coarse" => return Ok(Residual::Coarse),
        _ => {}
    }
    let expected = |_| "expected coarse, none, or a step from 1 to 255, or two, such as 64,32";
    let (luma, chroma) = text.split_once(',').unwrap_or((text, ""));
    let luma: NonZeroU8 = luma.parse().map_err(expected)?;
    let mut steps = Steps::from(luma);
    if text.contains(',') {
        steps.chroma = chroma.parse::<NonZeroU8>().map_err(expected)?.get();
    }
    Ok(Residual::Fine(steps))
}

pub fn size(text: &str) -> Result<(u32, u32), String> {
    let expected = "expected a size such as 1024x1024, both above 0";
    let (w, h) = text.split_once('x').ok_or(expected)?;
    match (w.parse(), h.parse()) {
        (Ok(w), Ok(h)) if w > 0 && h > 0 => Ok((w, h)),
        _ => Err(expected.into()),
    }
}

/// Where a camera stands: azimuth and elevation in degrees, and its distance if one is given.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Orbit {
    pub azimuth: f64,
    pub elevation: f64,
    pub distance: Option<f64>,
}

fn numbers(text: &str) -> Result<Vec<f64>, String> {
    let number = |t: &str| match t.trim().parse() {
        Ok(number) if f64::is_finite(number) => Ok(number),
        _ => Err(format!("'{t}' is not a number")),
    };
    text.split(',').map(number).collect()
}

pub fn orbit(text: &str) -> Result<Orbit, String> {
    let (azimuth, elevation, distance) = match numbers(text)?[..] {
        [azimuth, elevation] => (azimuth, elevation, None),
        [azimuth, elevation, distance] => (azimuth, elevation, Some(distance)),
        _ => return Err("expected two or three numbers: azimuth,elevation or azimuth,elevation,distance".into()),
    };
    Ok(Orbit {
        azimuth,
        elevation,
        distance,
    })
}

pub fn point(text: &str) -> Result<[f64; 3], String> {
    <[f64; 3]>::try_from(numbers(text)?).map_err(|_| "expected three numbers: x,y,z".into())
}

pub fn effect(text: &str) -> Result<(Effect, EffectMode), String> {
    let (name, choice) = text
        .split_once('=')
        .ok_or("expected an effect and a choice such as antialias=on")?;
    Ok((name.parse()?, choice.parse()?))
}

pub fn background(text: &str) -> Result<Background, String> {
    let named = match text {
        "transparent" => return Ok(Background::Transparent),
        "white" => [255; 3],
        "black" => [0; 3],
        "grey" | "gray" => [128; 3],
        _ => hex(text).ok_or("expected white, black, grey, #rrggbb or transparent")?,
    };
    Ok(Background::Colour(named.map(|v| f32::from(v) / 255.0)))
}

fn hex(text: &str) -> Option<[u8; 3]> {
    let digits = text.strip_prefix('#').filter(|d| d.len() == 6 && d.is_ascii())?;
    let channel = |i: usize| u8::from_str_radix(&digits[2 * i..2 * i + 2], 16).ok();
    Some([channel(0)?, channel(1)?, channel(2)?])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_read_as_written() {
        assert_eq!(levels("7..9"), Ok(7..=9));
        assert_eq!(size("640x480"), Ok((640, 480)));
        let from = |azimuth, elevation, distance| Orbit {
            azimuth,
            elevation,
            distance,
        };
        assert_eq!(orbit("-30, 10,2.5"), Ok(from(-30.0, 10.0, Some(2.5))));
        assert_eq!(orbit("20,-5"), Ok(from(20.0, -5.0, None)));
        assert_eq!(point("1,-2,3e5"), Ok([1.0, -2.0, 3e5]));
        assert_eq!(hex("#ff0080"), Some([255, 0, 128]));
        assert_eq!(bits_per_point("0.25"), Ok(0.25));
        assert_eq!(bytes("512"), Ok(512));
        assert_eq!(bytes("3k"), Ok(3 << 10));
        assert_eq!(bytes("2G"), Ok(2 << 30));
    }

    #[test]
    fn nonsense_is_refused_with_an_example() {
        assert!(bytes("2GB").unwrap_err().contains("500M"));
        assert!(bytes("-1").is_err() && bytes("99999999T").is_err());
        assert!(levels("9..7").unwrap_err().contains("after"));
        assert!(levels("9").unwrap_err().contains("7..9"));
        for wrong in ["0", "-1", "nan", "inf", "1e999", "few"] {
            assert!(bits_per_point(wrong).unwrap_err().contains("above 0"));
        }
        assert!(step("0").unwrap_err().contains("0.5") && step("8,inf").is_err());
        assert!(size("0x4").unwrap_err().contains("1024x1024"));
        assert!(orbit("1").unwrap_err().contains("three"));
        assert!(orbit("1,inf").is_err() && point("1,2").is_err());
        assert!(effect("antialias").unwrap_err().contains("antialias=on"));
        assert!(effect("glow=on").unwrap_err().contains("glow"));
        assert!(effect("antialias=maybe").is_err());
        assert!(background("#ff00").is_err());
        assert!(background("#ää").is_err());
    }
}
