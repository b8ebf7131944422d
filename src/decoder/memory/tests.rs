use super::*;
use crate::Placement;
use crate::container::{Format, Section};
use crate::gaussians::Heads;
use crate::gaussians::learned;
use crate::latents::network::{Model, Shape, untrained};

/// `214 + 2·C + 2·K`, with commas at thousands.
fn bytes(term: &Term) -> String {
    let Sizes {
        channels,
        latents,
        generator,
        base,
    } = term.by;
    let digits = term.fixed.to_string();
    let groups: Vec<&str> = digits
        .as_bytes()
        .rchunks(3)
        .rev()
        .map(|g| std::str::from_utf8(g).unwrap())
        .collect();
    let fixed = groups.join(",");
    let by = [(channels, 'C'), (latents, 'K'), (generator, 'H'), (base, 'B')];
    let by = by.iter().filter(|(times, _)| *times > 0);
    let by = by.map(|(times, of)| format!("{times}·{of}"));
    let fixed = (term.fixed > 0).then_some(fixed);
    let parts: Vec<String> = fixed.into_iter().chain(by).collect();
    parts.join(" + ")
}

fn table(terms: &[Term]) -> String {
    let row = |term: &Term| format!("| {} | {} | {} |\n", bytes(term), term.each, term.takes);
    let rows: String = terms.iter().map(row).collect();
    format!("| bytes | for each | of |\n|---|---|---|\n{rows}")
}

/// What contexts take depends on the size of addresses.
#[cfg(target_pointer_width = "64")]
#[test]
fn security_md_shows_the_terms_that_are_summed() {
    let text = include_str!(concat!(env!("CARGO_MANIFEST_DIR"), "/SECURITY.md"));
    let base = [BASE, BASE_LEARNING, NEAR, NEAR_LEARNING];
    let drawing = [GENERATOR, GAUSSIANS, EIGHT, ONE];
    let version_2 = [&[SLICES, OCTREE, ABOVE, EXACT][..], &base, &drawing].concat();
    let version_3 = [SLICES, OCTREE, KEPT, WINDOWS, CONTEXTS, TRUNK, KEPT_ABOVE, TABLE];
    let coding = [CODING, CODING_ABOVE, FILTERING, STEPS, SUMS, WALKS, SURFELS];
    let version_3 = [&version_3[..], &coding, &learned::TERMS].concat();
    let tables = [table(&version_2), table(&version_3)];
    let missing = tables.iter().filter(|table| !text.contains(*table));
    let missing: Vec<_> = missing.map(String::as_str).collect();
    assert!(missing.is_empty(), "SECURITY.md should have\n\n{}", missing.join("\n"));
}

fn header(base: u8, voxels: &[u32], format: Format) -> Header {
    let section = Section {
        geometry: 50,
        colours: 150,
    };
    Header {
        optional_flags: 0,
        bits: 12,
        base,
        top: base + voxels.len() as u8 - 1,
        points: 1 << 20,
        placement: Placement::VOXEL_GRID,
        format,
        slice_voxels: 8192,
        voxels: voxels.into(),
        sections: vec![section; voxels.len()],
    }
}

#[test]
fn the_bound_of_version_2_is_what_its_terms_say_of_the_counts() {
    let learning = Shape {
        learning: true,
        ..Shape::tiny()
    };
    let (mut one, mut many) = (0, 0);
    for shape in [Shape::tiny(), Shape::tiny().with_quick_heads(), learning] {
        let model = Model::from_bytes(&untrained(&shape, 0)).unwrap();
        let header = header(3, &[400, 1500, 6001], Format::Learned { model: model.id() });
        let decoder = LatentDecoder::new(&model);
        let [c, k, b] = [shape.channels, shape.latents, shape.base_channels].map(|size| size as u64);
        for (level, bytes, parents, voxels, sum) in [
            (3, 200, 0, 400, 400),
            (4, 400, 400, 1500, 1900),
            (5, 600, 1500, 6001, 7901),
        ] {
            let role = usize::from(level - 3);
            let learned = if shape.learning { 144 + 2 * k } else { 0 };
            let mut expected = 4 * (header.bytes() as u64 + bytes) + 13 * (sum + 3 * 400);
            expected += (214 + 2 * c + 2 * k) * parents + (230 + 10 * c + 7 * k) * voxels;
            if b > 0 {
                expected += (20 + 17 * k + 4 * b + learned) * 400;
            }
            if shape.corrects_up_to(role) {
                expected += (9 + 3 * k + learned) * voxels;
            }
            if let Some(head) = shape.head(role, Heads::Best) {
                let (h, gaussians) = (head.channels as u64, head.children as u64 * voxels);
                let kernel = if head.children == 1 { 208 + 6 * h } else { 100 + 6 * h };
                expected += (40 + 2 * c + 6 * h) * voxels + (112 + kernel) * gaussians;
                *(if head.children == 1 { &mut one } else { &mut many }) += 1;
            }
            assert_eq!(
                decoder.memory(&header, level).unwrap(),
                expected,
                "level {level} of {shape:?}"
            );
        }
        assert!(decoder.memory(&header, 6).is_err());
    }
    assert!(
        one > 0 && many > 0,
        "{one} levels with a Gaussian for a voxel, {many} with more"
    );
}

#[test]
fn a_level_of_version_2_is_refused_where_its_bound_is_above_the_limit() {
    let model = Model::from_bytes(&untrained(&Shape::tiny(), 0)).unwrap();
    let header = header(3, &[400, 1500], Format::Learned { model: model.id() });
    let decoder = LatentDecoder::new(&model);
    let bound = decoder.memory(&header, 4).unwrap();
    let within = |bytes| LatentDecoder::new(&model).with_limits(crate::Limits::default().with_max_bytes(bytes));
    assert!(within(bound).check_memory(&header, 4).is_ok());
    let refused = within(bound - 1).check_memory(&header, 4);
    assert!(
        matches!(refused, Err(crate::Error::LimitExceeded { .. })),
        "{refused:?}"
    );
}

#[test]
fn the_bound_of_version_3_is_what_its_terms_say_of_the_counts() {
    let colour_slice = 1000;
    let header = header(3, &[400, 1500, 6001], Format::Transform { colour_slice });
    let contexts = LevelColours::model_bytes() as u64;
    let kept = LevelColours::bytes_per_voxel() as u64 + 32 + 3;
    let threads = rayon::current_num_threads() as u64;
    let start = header.bytes() as u64;
    // Levels 0, 1 and 2 have at most 1, 8 and 64 voxels.
    let (all, trunk): (u64, u64) = (73, 73 * (32 + 14 + 2));
    let always = |bytes, voxels, up: [u64; 3]| {
        let windows = 14 * (up[0] + up[1]);
        4 * (start + bytes) + 13 * (voxels + all) + kept * (up[1] + up[2]) + windows + 3 * contexts
    };
    // Levels 1 and 2 have at most 8 and 64 voxels.
    let coding = |up: [u64; 3], slices: u64| {
        let colours = |slices: u64| trunk + (kept + 14) * up[0] + contexts * slices.min(threads);
        // No level above has so many voxels that its colours have two slices.
        let geometry = colours(1) + 14 * up[1] + 46 * up[0] + 108 * up[1];
        geometry.max(colours(slices) + 14 * up[2] + 46 * up[1])
    };
    let filtering = |voxels| 22 * voxels;
    for (level, bytes, voxels, up, slices) in [
        (3, 200, 400, [8, 64, 400], 1),
        (4, 400, 1900, [64, 400, 1500], 1),
        (5, 600, 7901, [400, 1500, 6001], 2),
    ] {
        let most = coding(up, slices).max(filtering(up[2]));
        let expected = always(bytes, voxels, up);
        assert_eq!(transform(&header, level, 0).unwrap(), expected + most, "level {level}");
        assert_eq!(transform(&header, level, most + 1).unwrap(), expected + most + 1);
    }
    assert!(transform(&header, 6, 0).is_err());
    assert_eq!(surfels(1000, 3, false), 1000 * 32 + 3000 * 56);
    assert_eq!(surfels(1000, 0, false), 1000 * 64);
    assert_eq!(surfels(1000, 3, true), (2 << 20) + 3000 * 56);
    assert_eq!(surfels(1 << 20, 3, true), (threads << 21) + (3 << 15) * 56);
}

#[test]
fn levels_above_the_base_have_no_more_voxels_than_it_nor_than_there_are_places() {
    let of = |base: u8, count: u32| {
        let header = header(base, &[count], Format::Transform { colour_slice: 65_536 });
        let with = transform(&header, base, 0).unwrap();
        let least = transform(&self::header(0, &[1], header.format), 0, 0).unwrap();
        (with, least)
    };
    // 0 to 6 have 1, 8, 64, 512, 4096, 32,768 and 70,000 at most; of these the trunk of colours has 65,536.
    let (with, least) = of(7, 70_000);
    let kept = LevelColours::bytes_per_voxel() as u64 + 32 + 3;
    let places = 1 + 8 + 64 + 512 + 4096 + 32_768;
    let always = 13 * (70_000 + places + 70_000) + kept * 140_000 + 14 * (70_000 + 32_768);
    let maps = 48 * (places + 65_536) + (kept + 14) * 32_768 + 108 * 70_000;
    let own = always + maps + 14 * 70_000 + 46 * 32_768;
    let one = 13 + 2 * kept + 2 * 14 + (kept + 14) + 108 + (14 + 46);
    assert_eq!(with + one, own + least);
}
