//! Models that have learned nothing: for tests and fuzzing.

use std::collections::HashMap;

use half::f16;
use safetensors::Dtype;
use safetensors::tensor::{TensorView, serialize};

use super::model::RAW;
use super::shape::{ROLES, Shape, Upsample};

/// The largest latent distance that an untrained model's rows hold; the rest escapes.
const REACH: i32 = 12;

/// A model file of this shape with random, well-scaled weights, which `seed` decides. The same bytes on every machine.
///
/// # Panics
/// If the shape is none that [`Shape::check`] allows.
pub fn untrained(shape: &Shape, seed: u64) -> Vec<u8> {
    shape.check().expect("a shape that a network can have");
    let mut file = File {
        tensors: Vec::new(),
        random: Random(seed.wrapping_mul(2).wrapping_add(1)),
    };
    let (c, k) = (shape.channels, shape.latents);
    for r in 0..ROLES {
        if r > 0 && shape.upsample == Upsample::Learned {
            file.shifted(&format!("up.{r}"), 8, c, c, c, 0);
        }
        if r > 0 {
            let name = format!("pem.{r}");
            file.invariant(&format!("{name}.conv_in"), 27, c, c);
            file.inceptions(&name, shape.pem_blocks, c, File::invariant);
            file.shifted(&format!("{name}.mu"), 1, c, k, 8 * c, 0);
            file.shifted(&format!("{name}.sigma"), 1, c, k, 64 * c, 24);
        }
        let name = format!("fr.{r}");
        let context = if r > 0 { c } else { 0 };
        file.shifted(&format!("{name}.lin1"), 1, k + context, c, k + context, 0);
        file.inceptions(
            &name,
            shape.fr_blocks,
            c,
            |file, name, volume, cin, cout| {
                file.shifted(name, volume, cin, cout, volume.div_ceil(2) * cin, 0);
            },
        );
        file.shifted(&format!("{name}.lin2"), 1, c, c, c, 0);
        let fs = format!("fs.{r}");
        file.float(&format!("{fs}.lin1"), 1, c + context, c, false);
        file.float(&format!("{fs}.lin2"), 1, c, k, false);
    }
    for r in 0..=ROLES {
        let name = format!("fc.{r}");
        file.float(
            &format!("{name}.conv_in"),
            27,
            if r == ROLES { 3 } else { c },
            c,
            true,
        );
        file.inceptions(
            &name,
            shape.fc_blocks,
            c,
            |file, name, volume, cin, cout| {
                file.float(name, volume, cin, cout, false);
            },
        );
        file.float(&format!("{name}.conv_out"), 27, c, c, true);
    }
    for head in &shape.gg {
        let (name, w) = (format!("gg.{}", head.role), head.channels);
        file.float(&format!("{name}.conv_in"), 27, c, w, true);
        for (part, blocks) in [("before", head.blocks_before), ("after", head.blocks_after)] {
            for b in 0..blocks {
                file.float(&format!("{name}.{part}.{b}.c1"), 27, w, w, false);
                file.float(&format!("{name}.{part}.{b}.c2"), 27, w, w, false);
            }
        }
        file.float(&format!("{name}.layer4"), 8, w, w, head.children == 1);
        file.float(&format!("{name}.conv_out"), 27, w, RAW, true);
    }
    file.push(
        "g_scale",
        vec![ROLES],
        &[1.0f32 / 256.0; ROLES],
        f32::to_le_bytes,
        Dtype::F32,
    );
    file.push(
        "c_scale",
        vec![ROLES],
        &[1.0f32 / 256.0; ROLES],
        f32::to_le_bytes,
        Dtype::F32,
    );
    file.tables(k);
    file.finish(shape)
}

struct File {
    tensors: Vec<(String, Dtype, Vec<usize>, Vec<u8>)>,
    random: Random,
}

impl File {
    fn push<T: Copy, const N: usize>(
        &mut self,
        name: &str,
        extents: Vec<usize>,
        values: &[T],
        bytes: fn(T) -> [u8; N],
        dtype: Dtype,
    ) {
        let data = values.iter().flat_map(|&v| bytes(v)).collect();
        self.tensors.push((name.to_owned(), dtype, extents, data));
    }

    fn exact_weights(&mut self, name: &str, volume: usize, cin: usize, cout: usize) {
        let weights: Vec<i16> = (0..volume * cin * cout)
            .map(|_| self.random.within(64) as i16)
            .collect();
        let extents = vec![volume, cin, cout];
        self.push(
            &format!("{name}.weight"),
            extents,
            &weights,
            i16::to_le_bytes,
            Dtype::I16,
        );
    }

    /// A layer whose output is about as large as its input if it sums `inputs` terms, around `offset`.
    fn shifted(
        &mut self,
        name: &str,
        volume: usize,
        cin: usize,
        cout: usize,
        inputs: usize,
        offset: i32,
    ) {
        self.exact_weights(name, volume, cin, cout);
        // Weights are about 37 large; a sum of n of them grows with √n.
        let shift = 5 + inputs.max(1).ilog2() as u8 / 2;
        let bias: Vec<i32> = (0..cout)
            .map(|_| ((offset + self.random.within(8)) << shift) + (1 << (shift - 1)))
            .collect();
        self.push(
            &format!("{name}.bias"),
            vec![cout],
            &bias,
            i32::to_le_bytes,
            Dtype::I32,
        );
        self.push(
            &format!("{name}.shift"),
            vec![cout],
            &vec![shift; cout],
            u8::to_le_bytes,
            Dtype::U8,
        );
    }

    fn invariant(&mut self, name: &str, volume: usize, cin: usize, cout: usize) {
        self.exact_weights(name, volume, cin, cout);
        let gain: Vec<f32> = (0..cout).map(|_| 1.0 + self.random.unit() / 2.0).collect();
        let bias: Vec<f32> = (0..cout).map(|_| 20.0 * self.random.unit()).collect();
        self.push(
            &format!("{name}.gain"),
            vec![cout],
            &gain,
            f32::to_le_bytes,
            Dtype::F32,
        );
        self.push(
            &format!("{name}.bias"),
            vec![cout],
            &bias,
            f32::to_le_bytes,
            Dtype::F32,
        );
    }

    fn float(&mut self, name: &str, volume: usize, cin: usize, cout: usize, normed: bool) {
        let size = 1.0 / ((volume.div_ceil(2) * cin) as f32).sqrt();
        let weights: Vec<f16> = (0..volume * cin * cout)
            .map(|_| f16::from_f32(size * self.random.unit()))
            .collect();
        let bias: Vec<f32> = (0..cout).map(|_| 0.1 * self.random.unit()).collect();
        let extents = vec![volume, cin, cout];
        self.push(
            &format!("{name}.weight"),
            extents,
            &weights,
            f16::to_le_bytes,
            Dtype::F16,
        );
        self.push(
            &format!("{name}.bias"),
            vec![cout],
            &bias,
            f32::to_le_bytes,
            Dtype::F32,
        );
        if normed {
            let gain: Vec<f32> = (0..cout).map(|_| 1.0 + self.random.unit() / 2.0).collect();
            self.push(
                &format!("{name}.gain"),
                vec![cout],
                &gain,
                f32::to_le_bytes,
                Dtype::F32,
            );
        }
    }

    fn inceptions(
        &mut self,
        module: &str,
        count: usize,
        c: usize,
        conv: impl Fn(&mut File, &str, usize, usize, usize),
    ) {
        let (narrow, wide) = (c / 4, c / 2);
        for b in 0..count {
            for (part, volume, cin, cout) in [
                ("a1", 27, c, narrow),
                ("a2", 27, narrow, wide),
                ("b1", 1, c, narrow),
                ("b2", 27, narrow, narrow),
                ("b3", 1, narrow, wide),
            ] {
                conv(
                    self,
                    &format!("{module}.blocks.{b}.{part}"),
                    volume,
                    cin,
                    cout,
                );
            }
        }
    }

    /// Bell-shaped rows without a transcendental function: `(1 + (x/σ)²)⁻²`, σ in 64 steps from 0.11.
    fn tables(&mut self, channels: usize) {
        let mut sigma = 0.11;
        let mut gauss = Vec::new();
        for _ in 0..64 {
            for frac in -8..8 {
                gauss.push(row(sigma, f64::from(frac) / 16.0));
            }
            sigma *= 1.1063;
        }
        self.rows("cdf.gauss", &gauss);
        self.rows("cdf.prior", &vec![row(3.0, 0.0); channels]);
    }

    fn rows(&mut self, name: &str, rows: &[(i16, Vec<u16>)]) {
        let entries: Vec<u16> = rows
            .iter()
            .flat_map(|(_, row)| row.iter().copied())
            .collect();
        let mut offset = vec![0u32];
        for (_, row) in rows {
            offset.push(offset[offset.len() - 1] + row.len() as u32);
        }
        let low: Vec<i16> = rows.iter().map(|(low, _)| *low).collect();
        self.push(
            name,
            vec![entries.len()],
            &entries,
            u16::to_le_bytes,
            Dtype::U16,
        );
        self.push(
            &format!("{name}.offset"),
            vec![offset.len()],
            &offset,
            u32::to_le_bytes,
            Dtype::U32,
        );
        self.push(
            &format!("{name}.low"),
            vec![low.len()],
            &low,
            i16::to_le_bytes,
            Dtype::I16,
        );
    }

    fn finish(self, shape: &Shape) -> Vec<u8> {
        let json = serde_json::to_string(shape).expect("a shape is plain data");
        let metadata = HashMap::from([("b2p".to_owned(), json)]);
        let views = self.tensors.iter().map(|(name, dtype, extents, data)| {
            let view =
                TensorView::new(*dtype, extents.clone(), data).expect("extents match the data");
            (name.as_str(), view)
        });
        serialize(views, Some(metadata)).expect("names are unique")
    }
}

/// A row's lowest symbol, and its probabilities minus 1.
fn row(sigma: f64, mean: f64) -> (i16, Vec<u16>) {
    let reach = (5.0 * sigma).clamp(1.0, f64::from(REACH)) as i32 + 1;
    let mass: Vec<f64> = (-reach..=reach)
        .map(|d| {
            let x = (f64::from(d) - mean) / sigma;
            1.0 / ((1.0 + x * x) * (1.0 + x * x))
        })
        .collect();
    let total: f64 = mass.iter().sum();
    let escape = 64;
    let free = 65_536 - escape - mass.len() as u32;
    let mut entries: Vec<u32> = mass
        .iter()
        .map(|m| 1 + (m / total * f64::from(free)) as u32)
        .collect();
    entries.push(escape);
    let rest = 65_536 - entries.iter().sum::<u32>();
    entries[reach as usize] += rest;
    (
        -reach as i16,
        entries.iter().map(|e| (e - 1) as u16).collect(),
    )
}

/// A small generator (xorshift64*): tests need variety, not quality.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        self.0.wrapping_mul(0x2545_f491_4f6c_dd1d)
    }

    /// From −1 to 1.
    fn unit(&mut self) -> f32 {
        (self.next() >> 40) as f32 / (1u32 << 23) as f32 - 1.0
    }

    /// From −`most` to `most`.
    fn within(&mut self, most: i32) -> i32 {
        (self.next() >> 33) as i32 % (2 * most + 1) - most
    }
}

#[cfg(test)]
mod tests {
    use super::super::Model;
    use super::*;

    #[test]
    fn untrained_models_load_and_each_seed_is_another_model() {
        let shape = Shape::tiny();
        let model = Model::from_bytes(&untrained(&shape, 1)).unwrap();
        assert_eq!(model.shape(), &shape);
        assert!(model.can_encode());
        assert_eq!(
            model.id(),
            Model::from_bytes(&untrained(&shape, 1)).unwrap().id()
        );
        assert_ne!(
            model.id(),
            Model::from_bytes(&untrained(&shape, 2)).unwrap().id()
        );
    }

    #[test]
    fn a_damaged_model_file_is_an_error_that_names_what_is_wrong() {
        let bytes = untrained(&Shape::tiny(), 1);
        for cut in [0, 7, 100, bytes.len() / 2, bytes.len() - 1] {
            assert!(Model::from_bytes(&bytes[..cut]).is_err(), "cut at {cut}");
        }
        let text = String::from_utf8_lossy(&bytes).into_owned();
        let at = text.find("up.1.weight").expect("the tensor's name");
        let mut renamed = bytes.clone();
        renamed[at] = b'q';
        assert!(
            Model::from_bytes(&renamed)
                .unwrap_err()
                .to_string()
                .contains("up.1")
        );
    }
}
