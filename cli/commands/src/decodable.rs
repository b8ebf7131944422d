//! What decoders will say of a stream that was just coded.

use std::path::Path;

use b2p::container::Header;
use b2p::{Decoder, Limits};

use super::args::{Colours, ModelArg};
use super::{Result, load, manners};

/// Warns of a stream that the program's own heads do not draw, or that decoders refuse by default.
pub fn warn(to: &Path, bytes: &[u8], colours: Colours, model: &ModelArg, limits: &Limits) -> Result<()> {
    let decoder = match colours {
        // The model at hand has coded it.
        Colours::Learned => Decoder::new().with_model(load::model(model)?),
        Colours::Transform => Decoder::new().with_heads_model(load::heads(None)?),
    };
    let decoder = decoder.with_limits(limits.clone());
    if decoder.levels(bytes)?.is_empty() {
        let what = match colours {
            Colours::Learned => "no level of the stream has Gaussians; code finer levels (--levels)",
            Colours::Transform => "no level of the stream is drawn with learned heads; --heads surfels draws it",
        };
        manners::warn(&format!("{}: {what}", to.display()));
    }
    if let Some(what) = too_large(&decoder, &Header::parse(bytes, limits)?)? {
        manners::warn(&format!("{}: {what}", to.display()));
    }
    Ok(())
}

/// Says how to decode a stream whose finest level takes more memory than decoders allow by default.
fn too_large(decoder: &Decoder, header: &Header) -> Result<Option<String>> {
    let most = Limits::default().max_bytes;
    let needed = decoder.memory(header, header.top)?;
    if needed <= most {
        return Ok(None);
    }
    let fits = |level: &u8| decoder.memory(header, *level).is_ok_and(|bytes| bytes <= most);
    let coarser = match (header.base..header.top).rev().find(fits) {
        Some(level) => format!(", or --level {level}"),
        None => String::new(),
    };
    let (level, megabytes) = (header.top, needed.div_ceil(1 << 20));
    Ok(Some(format!(
        "decoding level {level} may take {megabytes} MiB of memory, which is refused by default; decode with \
         --max-memory {megabytes}M{coarser}"
    )))
}

#[cfg(test)]
mod tests {
    use super::*;
    use b2p::container::{Format, Section};
    use b2p::{Error, Placement};

    fn header(voxels: [u32; 3]) -> Header {
        Header {
            optional_flags: 0,
            bits: 12,
            base: 10,
            top: 12,
            points: voxels[2].into(),
            placement: Placement::VOXEL_GRID,
            format: Format::Transform { colour_slice: 8192 },
            slice_voxels: 16_384,
            voxels: voxels.to_vec(),
            sections: vec![
                Section {
                    geometry: 100,
                    colours: 100
                };
                3
            ],
        }
    }

    #[test]
    fn every_number_of_voxels_is_decoded_by_default_or_warned_of() {
        let heads = load::heads(None).unwrap();
        let decoders = [Decoder::new(), Decoder::new().with_heads_model(heads)];
        let (mut decoded, mut warned) = (0, 0);
        for decoder in decoders {
            // Counts up to 2²⁶, a sixth more each; surfaces, lines and solids.
            let counts = std::iter::successors(Some(1u64), |n| Some(n + 1 + n / 6));
            for count in counts.take_while(|n| *n <= 1 << 26) {
                for branching in [1, 4, 8] {
                    let above = count.div_ceil(branching);
                    let header = header([above.div_ceil(branching), above, count].map(|n| n as u32));
                    let refused = match decoder.decode(&header.write()) {
                        Err(Error::Truncated { .. }) => false,
                        Err(Error::LimitExceeded { option, .. }) => {
                            assert_eq!(option, "max_bytes");
                            true
                        }
                        other => panic!("{count} voxels: {other:?}"),
                    };
                    let warning = too_large(&decoder, &header).unwrap();
                    assert_eq!(warning.is_some(), refused, "{count} voxels");
                    (decoded, warned) = (decoded + usize::from(!refused), warned + usize::from(refused));
                    let Some(warning) = warning else { continue };
                    // What it proposes is accepted.
                    let (_, rest) = warning.split_once("--max-memory ").unwrap();
                    let megabytes: u64 = rest.split_once('M').unwrap().0.parse().unwrap();
                    let raised = Limits::default().with_max_bytes(megabytes << 20);
                    let raised = decoder.clone().with_limits(raised).decode(&header.write());
                    assert!(
                        matches!(raised, Err(Error::Truncated { .. })),
                        "{count} voxels: {raised:?}"
                    );
                }
            }
        }
        assert!(decoded > 100 && warned > 10, "{decoded} decoded, {warned} warned of");
    }
}
