//! What can be wrong with a stream, and the clause of `docs/format.md` that it breaks.

use super::parts::{Chunk, Parts, varint};

/// A kind of damage.
pub struct Kind {
    pub name: &'static str,
    /// The stream that is damaged.
    pub stream: &'static str,
    pub clause: &'static str,
    /// Damaged streams, of which the first that breaks the clause is taken.
    pub tries: Vec<Vec<u8>>,
}

/// What collects kinds of damage of a stream.
struct Kinds<'a> {
    stream: &'static str,
    whole: Parts,
    kinds: &'a mut Vec<Kind>,
}

impl Kinds<'_> {
    /// Damage that is certain to break the clause.
    fn add(&mut self, name: &'static str, clause: &'static str, damage: impl FnOnce(&mut Parts)) {
        let mut parts = self.whole.clone();
        damage(&mut parts);
        self.push(name, clause, vec![parts]);
    }

    /// Damage that depends on a number, which is found by trial.
    fn find(&mut self, name: &'static str, clause: &'static str, damage: impl Fn(&mut Parts, usize)) {
        let tries = (0..300).map(|i| {
            let mut parts = self.whole.clone();
            damage(&mut parts, i);
            parts
        });
        let tries = tries.collect();
        self.push(name, clause, tries);
    }

    fn push(&mut self, name: &'static str, clause: &'static str, tries: Vec<Parts>) {
        let stream = self.stream;
        self.kinds.push(Kind {
            name,
            stream,
            clause,
            tries: tries.iter().map(Parts::bytes).collect(),
        });
    }
}

/// All kinds; `read` reads a stream of the suite.
pub fn all(read: impl Fn(&str) -> Parts) -> Vec<Kind> {
    let mut kinds = Vec::new();
    let mut of = |stream: &'static str, add: &[fn(&mut Kinds)]| {
        let whole = read(stream);
        let mut kinds = Kinds {
            stream,
            whole,
            kinds: &mut kinds,
        };
        add.iter().for_each(|add| add(&mut kinds));
    };
    // Levels 2 to 4 of 5 bits. Levels 2 and 3 have one chunk in each section; level 4 has two, and a colour filter.
    let main = "version-3/coarse-steps";
    of(
        main,
        &[
            magic,
            flags,
            levels,
            counts,
            placement,
            sections,
            checksums,
            chunk_heads,
        ],
    );
    of(main, &[geometry_chunks, trunk, colour_chunks, filter_chunks]);
    of(main, &[geometry_code, steps, filters]);
    of("version-3/fine-steps", &[colour_code]);
    of(
        "version-3/all-levels",
        &[|kinds| {
            kinds.add("geometry-of-level-0", "3.2.1", |s| {
                let chunk = Chunk::new(1, 0, 0, 1, &[0; 4]);
                s.geometry(0).push(chunk);
            });
        }],
    );
    of(
        "version-3/exact",
        &[|kinds| {
            kinds.add("lossy-below-lossless", "5.1.3", |s| {
                s.colours(1)[0].payload[8..10].copy_from_slice(&[20, 20])
            });
        }],
    );
    of("bare-filtered", &[learned, learned_filters]);
    of("bare-residual", &[learned_residuals]);
    kinds
}

fn magic(kinds: &mut Kinds) {
    let clause = "2.2.1";
    for (name, end) in [
        ("empty", 0),
        ("cut-in-the-magic", 5),
        ("cut-in-the-version", 9),
        ("cut-in-the-placement", 40),
        ("cut-in-the-voxel-counts", 77),
        ("cut-in-the-header-checksum", 110),
    ] {
        kinds.add(name, clause, |s| s.end = Some(end));
    }
    kinds.add("magic-without-high-bit", clause, |s| s.fixed[0] = 9);
    kinds.add("magic-of-another-format", clause, |s| s.fixed[2] = b'3');
    kinds.add("magic-with-unix-line-ends", clause, |s| {
        s.fixed.retain(|byte| *byte != b'\r')
    });
    kinds.add("magic-with-dos-line-ends", clause, |s| s.fixed.insert(7, b'\r'));
    kinds.add("version-1", clause, |s| s.fixed[8] = 1);
    kinds.add("version-4", clause, |s| s.fixed[8] = 4);
    kinds.add("version-big-endian", clause, |s| s.put(8, &[0, 3]));
    kinds.add("header-checksum", clause, |s| s.sum = 1 << 9);
}

fn flags(kinds: &mut Kinds) {
    let clause = "2.2.1";
    kinds.add("critical-flag-0", clause, |s| s.fixed[12] = 1);
    kinds.add("critical-flag-31", clause, |s| s.fixed[15] = 0x80);
    kinds.add("reserved-byte", clause, |s| s.fixed[23] = 1);
    kinds.add("slice-size-0", clause, |s| s.put(64, &[0; 4]));
    kinds.add("slice-size-16385", clause, |s| s.put(64, &16_385u32.to_le_bytes()));
    kinds.add("colour-slice-size-0", clause, |s| s.put(68, &[0; 4]));
    kinds.add("colour-slice-size-65537", clause, |s| {
        s.put(68, &65_537u32.to_le_bytes())
    });
}

fn levels(kinds: &mut Kinds) {
    let clause = "2.2.2";
    kinds.add("base-above-top", clause, |s| s.put(21, &[5, 4]));
    kinds.add("top-22", clause, |s| s.put(21, &[20, 22]));
    kinds.add("levels-22", clause, |s| s.put(21, &[0, 21]));
    kinds.add("bit-depth-0", clause, |s| s.fixed[20] = 0);
    kinds.add("bit-depth-22", clause, |s| s.fixed[20] = 22);
    kinds.add("bit-depth-below-top", clause, |s| s.fixed[20] = 3);
}

fn counts(kinds: &mut Kinds) {
    let clause = "2.2.2";
    let points = |s: &mut Parts, points: u32| s.put(24, &u64::from(points).to_le_bytes());
    kinds.add("points-none", clause, |s| points(s, 0));
    kinds.add("points-fewer-than-voxels", clause, |s| points(s, s.voxels[2] - 1));
    kinds.add("points-too-many", clause, |s| points(s, 8 * s.voxels[2] + 1));
    kinds.add("voxels-none", clause, |s| s.voxels[0] = 0);
    kinds.add("voxels-more-than-the-cube", clause, |s| s.voxels[0] = 65);
    kinds.add("voxels-fewer-than-above", clause, |s| s.voxels[1] = s.voxels[0] - 1);
    kinds.add("voxels-more-than-children", clause, |s| {
        s.voxels[1] = 8 * s.voxels[0] + 1
    });
}

fn placement(kinds: &mut Kinds) {
    for (name, at, value) in [
        ("origin-x-nan", 32, f64::NAN),
        ("origin-y-infinite", 40, f64::INFINITY),
        ("origin-z-minus-infinite", 48, f64::NEG_INFINITY),
        ("voxel-size-0", 56, 0.0),
        ("voxel-size-negative", 56, -1.0),
        ("voxel-size-nan", 56, f64::NAN),
        ("voxel-size-infinite", 56, f64::INFINITY),
    ] {
        kinds.add(name, "2.2.3", |s| s.put(at, &value.to_le_bytes()));
    }
}

fn sections(kinds: &mut Kinds) {
    kinds.add("geometry-section-too-long", "2.1.2", |s| s.longer[0] = [1, -1]);
    kinds.add("geometry-section-too-short", "2.1.2", |s| s.longer[0] = [-1, 1]);
    kinds.add("colour-section-too-short", "2.1.2", |s| {
        s.longer[2][1] = -1;
        s.end = Some(s.bytes().len() - 1);
    });
    kinds.add("colour-section-too-long", "2.1.1", |s| s.longer[2][1] = 1);
    kinds.add("sections-of-4-gib", "2.1.1", |s| s.longer[1] = [0xffff_0000; 2]);
    kinds.add("cut-in-colours", "2.1.1", |s| s.end = Some(s.bytes().len() - 10));
    kinds.add("cut-by-a-byte", "2.1.1", |s| s.end = Some(s.bytes().len() - 1));
    kinds.add("cut-after-the-header", "2.1.1", |s| s.end = Some(s.fixed.len() + 40));
    kinds.add("byte-after-the-end", "2.1.1", |s| s.tail = vec![0]);
    kinds.add("stream-after-the-end", "2.1.1", |s| s.tail = s.bytes());
}

fn checksums(kinds: &mut Kinds) {
    let clause = "3.1.1";
    kinds.add("checksum-of-geometry-trunk", clause, |s| s.geometry(0)[0].sum = 1);
    kinds.add("checksum-of-geometry", clause, |s| s.geometry(1)[0].sum = 1 << 31);
    kinds.add("checksum-of-colour-trunk", clause, |s| s.colours(0)[0].sum = 1 << 7);
    kinds.add("checksum-of-colours", clause, |s| s.colours(2)[1].sum = 1 << 8);
    kinds.add("checksum-of-colour-filter", clause, |s| s.colours(2)[2].sum = !0);
    kinds.add("checksum-of-ancillary-chunk", clause, |s| {
        let mut chunk = Chunk::new(200, 0, 0, 0, b"advice");
        chunk.sum = 1;
        s.geometry(1).insert(0, chunk);
    });
    kinds.add("checksum-of-head-map", clause, |s| {
        let mut chunk = Chunk::new(129, 3, 0, 0, &[64, 64, 0]);
        chunk.sum = 1;
        s.colours(1).push(chunk);
    });
}

fn chunk_heads(kinds: &mut Kinds) {
    for (name, code) in [("type-0", 0), ("type-2", 2), ("type-9", 9), ("type-127", 127)] {
        kinds.add(name, "3.1.2", |s| s.colours(1).push(Chunk::new(code, 3, 0, 0, &[])));
    }
    kinds.add("type-unknown-in-geometry", "3.1.2", |s| s.geometry(2)[0].kind = 40);
    kinds.add("slice-65536", "3.1.1", |s| s.geometry(1)[0].slice = varint(65_536));
    kinds.add("slice-not-shortest", "1.4.2", |s| {
        s.geometry(1)[0].slice = vec![0x80, 0]
    });
    kinds.add("count-of-six-bytes", "1.4.2", |s| {
        s.colours(0)[0].count = vec![0x80, 0x80, 0x80, 0x80, 0x80, 1]
    });
    kinds.add("length-of-33-bits", "1.4.2", |s| {
        s.colours(1)[0].length = Some(varint(1 << 32))
    });
    kinds.add("length-not-shortest", "1.4.2", |s| {
        let chunk = &mut s.geometry(2)[1];
        let mut length = varint(chunk.payload.len() as u64);
        *length.last_mut().unwrap_or(&mut 0) |= 0x80;
        length.push(0);
        chunk.length = Some(length);
    });
    kinds.add("length-beyond-the-section", "2.1.2", |s| {
        s.colours(1)[0].length = Some(varint(5000))
    });
    kinds.add("section-ends-in-a-head", "2.1.2", |s| {
        s.geometry(1).push(Chunk::raw(&[200, 0, 0]))
    });
}

fn geometry_chunks(kinds: &mut Kinds) {
    let of_section = "3.2.1";
    kinds.add("geometry-trunk-missing", of_section, |s| s.geometry(0).clear());
    kinds.add("geometry-trunk-twice", of_section, |s| {
        let again = s.geometry(0)[0].clone();
        s.geometry(0).push(again);
    });
    kinds.add("geometry-trunk-of-slice-1", of_section, |s| {
        s.geometry(0)[0].slice = vec![1]
    });
    kinds.add("geometry-trunk-of-level-0", of_section, |s| s.geometry(0)[0].level = 0);
    kinds.add("geometry-trunk-too-deep", of_section, |s| s.geometry(0)[0].level = 3);
    kinds.add("geometry-in-place-of-trunk", of_section, |s| s.geometry(0)[0].kind = 1);
    kinds.add("geometry-slice-too-many", of_section, |s| {
        let mut more = s.geometry(2)[1].clone();
        more.slice = vec![2];
        s.geometry(2).push(more);
    });
    kinds.add("filter-in-geometry-section", of_section, |s| {
        let filter = s.colours(2)[2].clone();
        s.geometry(2).push(filter);
    });
    let of_slices = "3.2.3";
    kinds.add("geometry-slices-swapped", of_slices, |s| s.geometry(2).swap(0, 1));
    kinds.add("geometry-slice-missing", of_slices, |s| drop(s.geometry(2).pop()));
    kinds.add("geometry-slice-twice", of_slices, |s| {
        let again = s.geometry(2)[0].clone();
        s.geometry(2).insert(1, again);
    });
    kinds.add("geometry-of-another-level", of_slices, |s| s.geometry(1)[0].level = 4);
    kinds.add("colours-in-geometry-section", of_slices, |s| s.geometry(1)[0].kind = 7);
    kinds.add("geometry-section-empty", of_slices, |s| s.geometry(1).clear());
    kinds.add("children-fewer-than-parents", of_slices, |s| {
        s.geometry(1)[0].count = vec![55]
    });
    kinds.add("children-more-than-8-each", of_slices, |s| {
        s.geometry(1)[0].count = varint(449)
    });
    kinds.add("children-fewer-than-the-header-says", "3.2.4", |s| {
        s.geometry(1)[0].count_by(-1)
    });
    kinds.add("children-more-than-the-header-says", "3.2.4", |s| {
        s.geometry(1)[0].count_by(1)
    });
}

/// Level 1 has 8 voxels, level 2 has 56.
fn trunk(kinds: &mut Kinds) {
    let clause = "3.2.2";
    /// Byte offset of the count of level 2.
    fn second(s: &mut Parts) -> usize {
        2 + usize::from(s.geometry(0)[0].payload[1])
    }
    let set = |s: &mut Parts, at: usize, value: u8| s.geometry(0)[0].payload[at] = value;
    kinds.add("trunk-voxels-none", clause, |s| set(s, 0, 0));
    kinds.add("trunk-voxels-more-than-8", clause, |s| set(s, 0, 9));
    kinds.add("trunk-voxels-fewer-than-above", clause, |s| {
        let at = second(s);
        set(s, at, 7);
    });
    kinds.add("trunk-voxels-more-than-the-header-says", "3.2.4", |s| {
        let at = second(s);
        set(s, at, 57);
    });
    kinds.add("trunk-count-differs", clause, |s| s.geometry(0)[0].count_by(1));
    kinds.add("trunk-code-too-long", clause, |s| set(s, 1, 100));
    kinds.add("trunk-ends-early", clause, |s| {
        let at = second(s);
        s.geometry(0)[0].payload.truncate(at);
    });
    kinds.add("trunk-empty", clause, |s| s.geometry(0)[0].payload.clear());
    kinds.add("trunk-goes-on", clause, |s| s.geometry(0)[0].payload.push(0));
    kinds.add("trunk-in-several-slices", clause, |s| s.put(64, &7u32.to_le_bytes()));
    kinds.add("trunk-varint-not-shortest", "1.4.2", |s| {
        set(s, 0, 0x88);
        s.geometry(0)[0].payload.insert(1, 0);
    });
}

fn colour_chunks(kinds: &mut Kinds) {
    let of_trunk = "3.3.1";
    kinds.add("colour-trunk-missing", of_trunk, |s| s.colours(0).clear());
    kinds.add("colour-trunk-too-deep", of_trunk, |s| s.colours(0)[0].level = 3);
    kinds.add("colour-trunk-of-slice-1", of_trunk, |s| s.colours(0)[0].slice = vec![1]);
    kinds.add("colour-trunk-count", of_trunk, |s| s.colours(0)[0].count_by(-1));
    kinds.add("colours-in-place-of-trunk", of_trunk, |s| s.colours(0)[0].kind = 7);
    let of_slices = "3.3.2";
    kinds.add("colour-slices-swapped", of_slices, |s| s.colours(2).swap(0, 1));
    kinds.add("colour-slice-missing", of_slices, |s| drop(s.colours(2).remove(1)));
    kinds.add("colour-slice-twice", of_slices, |s| {
        let again = s.colours(2)[0].clone();
        s.colours(2).insert(1, again);
    });
    kinds.add("colours-of-another-level", of_slices, |s| s.colours(1)[0].level = 4);
    kinds.add("colours-count", of_slices, |s| s.colours(1)[0].count_by(1));
    kinds.add("colour-section-empty", of_slices, |s| s.colours(1).clear());
    kinds.add("colour-slice-size-differs", of_slices, |s| {
        s.put(68, &50u32.to_le_bytes())
    });
    kinds.add("colour-hash-short", "3.3.3", |s| s.colours(1)[0].payload.truncate(7));
}

fn filter_chunks(kinds: &mut Kinds) {
    let clause = "3.3.4";
    kinds.add("filter-before-colours", "3.3.2", |s| s.colours(2).rotate_right(1));
    kinds.add("filter-twice", clause, |s| {
        let again = s.colours(2)[2].clone();
        s.colours(2).push(again);
    });
    kinds.add("filter-of-slice-1", clause, |s| s.colours(2)[2].slice = vec![1]);
    kinds.add("filter-of-another-level", clause, |s| s.colours(2)[2].level = 3);
    kinds.add("filter-count", clause, |s| s.colours(2)[2].count_by(-1));
    kinds.add("colour-slice-too-many", clause, |s| {
        let mut more = s.colours(2)[1].clone();
        more.slice = vec![2];
        s.colours(2).insert(2, more);
    });
    kinds.add("colour-trunk-twice", clause, |s| {
        let again = s.colours(0)[0].clone();
        s.colours(0).push(again);
    });
}

fn geometry_code(kinds: &mut Kinds) {
    let clause = "4.2.3";
    kinds.add("geometry-code-empty", clause, |s| s.geometry(1)[0].payload.clear());
    kinds.add("geometry-code-goes-on", clause, |s| s.geometry(1)[0].payload.push(0));
    kinds.find("geometry-code-ends-early", clause, |s, i| {
        let code = &mut s.geometry(1)[0].payload;
        code.truncate(code.len().saturating_sub(i + 1));
    });
    kinds.find("geometry-code-ends-in-another-state", clause, |s, i| {
        let code = &mut s.geometry(1)[0].payload;
        let last = code.len() - 1;
        code[last] ^= 1 << (i % 8);
    });
    kinds.find("geometry-code-with-too-many-children", "4.1.3", |s, i| {
        let code = &mut s.geometry(1)[0].payload;
        let at = i / 8 % code.len();
        code[at] ^= 1 << (i % 8);
    });
    kinds.find("trunk-code-changed", clause, |s, i| {
        let payload = &mut s.geometry(0)[0].payload;
        let last = payload.len() - 1 - i / 8 % 4;
        payload[last] ^= 1 << (i % 8);
    });
    // Header and chunk agree, the code does not.
    for (name, change) in [("children-fewer-than-coded", -1), ("children-more-than-coded", 1)] {
        kinds.add(name, "4.1.3", |s| {
            s.voxels[1] = s.voxels[1].wrapping_add_signed(change);
            s.geometry(1)[0].count_by(change.into());
        });
    }
}

/// Colour payloads start with the hash, then luma, chroma and gain.
fn steps(kinds: &mut Kinds) {
    kinds.add("colours-without-steps", "5.3", |s| s.colours(1)[0].payload.truncate(8));
    kinds.add("colours-without-gain", "5.3", |s| s.colours(1)[0].payload.truncate(10));
    kinds.add("colour-trunk-without-root", "5.3", |s| {
        s.colours(0)[0].payload.truncate(8 + 7)
    });
    for (name, luma, chroma) in [
        ("luma-step-88", 88, 20),
        ("luma-step-254", 254, 20),
        ("chroma-step-88", 20, 88),
        ("chroma-step-253", 20, 253),
        ("luma-alone-lossless", 255, 20),
        ("chroma-alone-lossless", 20, 255),
    ] {
        let steps = [luma, chroma];
        kinds.add(name, "5.2.1", |s| {
            s.colours(1)[0].payload[8..10].copy_from_slice(&steps)
        });
    }
    kinds.add("luma-step-of-trunk", "5.2.1", |s| s.colours(0)[0].payload[8] = 88);
    kinds.add("lossless-below-lossy", "5.1.3", |s| {
        s.colours(1)[0].payload[8..10].fill(255)
    });
    let root = |s: &mut Parts, at: usize, value: i16| {
        s.colours(0)[0].payload[8 + at..10 + at].copy_from_slice(&value.to_le_bytes());
    };
    kinds.add("root-co-256", "5.3.2", |s| root(s, 4, 256));
    kinds.add("root-cg-minus-256", "5.3.2", |s| root(s, 6, -256));
}

fn colour_code(kinds: &mut Kinds) {
    let (of_quantile, of_words, of_hash) = ("5.4.2", "5.4.3", "5.10.1");
    kinds.add("colour-code-of-odd-length", of_words, |s| {
        s.colours(1)[0].payload.push(0)
    });
    kinds.add("colour-code-empty", of_words, |s| s.colours(1)[0].payload.truncate(11));
    kinds.add("colour-code-goes-on", of_words, |s| {
        s.colours(1)[0].payload.extend([0; 12])
    });
    kinds.add("colour-trunk-code-goes-on", of_words, |s| {
        s.colours(0)[0].payload.extend([0; 12])
    });
    kinds.add("colour-code-quantile", of_quantile, |s| {
        s.colours(1)[0].payload[11..].fill(255)
    });
    kinds.add("colour-trunk-code-quantile", of_quantile, |s| {
        s.colours(0)[0].payload[16..].fill(255)
    });
    kinds.add("colour-hash", of_hash, |s| s.colours(1)[0].payload[7] ^= 1);
    kinds.add("colour-hash-of-trunk", of_hash, |s| s.colours(0)[0].payload[0] ^= 1);
    kinds.find("colour-code-changed", of_hash, |s, i| {
        let payload = &mut s.colours(1)[0].payload;
        let at = payload.len() - 1 - i / 8 % (payload.len() - 11);
        payload[at] ^= 1 << (i % 8);
    });
    kinds.find("root-y-changed", of_hash, |s, i| {
        s.colours(0)[0].payload[8 + 3] ^= 1 << (i % 7)
    });
}

fn filters(kinds: &mut Kinds) {
    let clause = "5.11.1";
    kinds.add("filter-empty", clause, |s| s.colours(2)[2].payload.clear());
    kinds.add("filter-of-no-pass", clause, |s| s.colours(2)[2].payload[0] = 0);
    kinds.add("filter-of-three-passes", clause, |s| s.colours(2)[2].payload[0] = 3);
    kinds.add("filter-short", clause, |s| s.colours(2)[2].payload.truncate(15));
    kinds.add("filter-long", clause, |s| s.colours(2)[2].payload.push(0));
}

/// The first level of version 2 has geometry, features and filters.
fn learned(kinds: &mut Kinds) {
    kinds.add("learned-checksum", "8.1.1", |s| s.colours(0)[0].sum = 1);
    kinds.add("learned-type-5", "8.1.2", |s| s.geometry(0)[0].kind = 5);
    kinds.add("learned-geometry-missing", "8.2.1", |s| drop(s.geometry(0).pop()));
    kinds.add("learned-geometry-of-another-level", "8.2.1", |s| {
        s.geometry(0)[0].level = 7
    });
    kinds.add("learned-geometry-count", "8.2.1", |s| {
        s.geometry(0)[0].count = vec![9, 0, 0, 0]
    });
    kinds.add("learned-geometry-code-goes-on", "4.2.3", |s| {
        s.geometry(0)[0].payload.push(0)
    });
    kinds.add("learned-features-missing", "8.2.2", |s| {
        s.colours(0).retain(|chunk| chunk.kind != 2)
    });
    kinds.add("learned-features-of-another-slice", "8.2.2", |s| {
        s.colours(0)[0].slice = vec![1, 0]
    });
    kinds.add("learned-hash-short", "8.2.2", |s| s.colours(0)[0].payload.truncate(7));
    kinds.add("learned-hash", "8.2.2", |s| s.colours(0)[0].payload[0] ^= 1);
    kinds.add("learned-state-short", "10.3.1", |s| {
        s.colours(0)[0].payload.truncate(8 + 4)
    });
    kinds.add("learned-state-not-shortest", "10.3.1", |s| {
        let payload = &mut s.colours(0)[0].payload;
        let first = 5 + (payload.len() - 8 - 5) % 4;
        payload[8 + first - 1] = 0;
    });
    kinds.add("learned-words-left", "10.3.5", |s| {
        s.colours(0)[0].payload.extend([1; 400])
    });
    kinds.add("learned-base-too-deep", "2.2.2", |s| {
        s.fixed[20..23].copy_from_slice(&[21, 21, 21])
    });
    kinds.add("learned-slice-size-0", "2.2.1", |s| s.put(80, &[0; 4]));
}

fn learned_filters(kinds: &mut Kinds) {
    fn filter(s: &mut Parts) -> &mut Chunk {
        let chunks = s.sections.iter_mut().flat_map(|parts| &mut parts[1]);
        let mut filters = chunks.filter(|chunk| chunk.kind == 3);
        filters.next().expect("the stream has a filter")
    }
    kinds.add("learned-filter-short", "14.1.1", |s| filter(s).payload.truncate(57));
    kinds.add("learned-filter-exponent", "14.1.1", |s| filter(s).payload[0] = 16);
}

fn learned_residuals(kinds: &mut Kinds) {
    fn residual(s: &mut Parts) -> &mut Chunk {
        let chunks = s.sections.iter_mut().flat_map(|parts| &mut parts[1]);
        let mut residuals = chunks.filter(|chunk| chunk.kind == 4);
        residuals.next().expect("the stream has a residual")
    }
    kinds.add("residual-without-steps", "14.2.1", |s| residual(s).payload[..4].fill(0));
    kinds.add("residual-boundary-64", "14.2.1", |s| residual(s).payload[4] = 64);
    kinds.add("residual-short", "14.2.1", |s| residual(s).payload.truncate(3));
    kinds.add("residual-state-short", "10.3.1", |s| {
        residual(s).payload.truncate(5 + 4)
    });
    kinds.add("residual-words-left", "10.3.5", |s| {
        residual(s).payload.extend([1; 4000])
    });
    kinds.add("residual-of-another-slice", "8.2.2", |s| residual(s).slice = vec![9, 0]);
}
