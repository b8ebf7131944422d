//! Generation with sums in f16, where there are any.

use b2p_kernels::Isa;

use super::super::reference::{Mode, Oracle};
use super::super::{Head, Model, untrained};
use super::definition::{shapes, some_features};
use super::{Cloud, error, rows};
use crate::layers::Precision;

/// Twice what f16 is allowed for storing: a sum of sixteen loses about as much again.
const TOLERANCE: f64 = 2.0 * 10.0 / 4096.0;

fn in_precision(bytes: &[u8], isa: Isa, precision: Precision) -> crate::Result<Model> {
    let model = Model::from_bytes(bytes)?.with_isa(isa);
    model.with_precision(precision)
}

#[test]
fn generation_in_half_follows_its_definition_or_is_refused() {
    let cloud = Cloud::sheet();
    for (seed, shape) in (10..).zip(shapes()) {
        let bytes = untrained(&shape, seed);
        let oracle = Oracle::new(&bytes, Mode::Whole);
        for &Head { role, heads, .. } in &shape.gg {
            let g = some_features(cloud.len(role) * shape.channels);
            let features = rows(&g, shape.channels);
            let want = oracle.generate(heads, role, &cloud.sites(role), &features);
            let generate = |model: &Model| {
                let raw = model.generate_with(heads, role, &g, &cloud.maps[role]);
                raw.unwrap()
            };
            let floats = in_precision(&bytes, Isa::SCALAR, Precision::F16).unwrap();
            let floats = generate(&floats);
            for isa in Isa::available() {
                let model = match in_precision(&bytes, isa, Precision::Half) {
                    Ok(model) => model,
                    Err(error) => {
                        assert!(!isa.has_half() && error.to_string().contains(&isa.to_string()));
                        continue;
                    }
                };
                let got = generate(&model);
                let (off, peak) = error(&got, &want);
                println!("{isa}, {heads}, role {role}: {:.2e} of {peak:.2}", off / peak);
                assert!(off < TOLERANCE * peak, "off by {off} of {peak}");
                assert!(got != floats, "{isa} sums in f32");
                let without = model.with_isa(Isa::SCALAR);
                assert!(generate(&without) == floats, "f16 without sums in it");
            }
        }
    }
}
