//! Models made up from a seed: for tests and fuzzing, where any valid model will do. The same bytes on every machine.

use b2p_kernels::f16;

use super::shape::Shape;
use super::structure::ROLES;
use crate::error::Result;
use crate::layers::{Dtype, File as Container, Spec};

/// Taps of a 3³ kernel that read something, on a surface.
const TAPS_IN_USE: usize = 12;
/// The largest integer weight made here: room enough to double some.
const WEIGHT: i32 = 127;
/// Magnitude of the largest value that a table row covers; the escape has the rest.
const REACH: i32 = 24;

/// The content of a model file of that shape with pseudo-random weights, scaled so that activations neither fade nor
/// saturate, and with sound tables: Gaussian ones, and for the base level a Gaussian of σ = 3 in every channel.
///
/// # Panics
/// If the shape is one that loading would refuse.
pub fn untrained(shape: &Shape, seed: u64) -> Vec<u8> {
    let mut file = File {
        random: seed,
        file: Container::new([("b2p".to_owned(), shape.to_json())].into()),
    };
    let [exact, float] = layers(shape).expect("listing layers has no way to fail");
    // Optional parts come last: with and without them, everything else is the same.
    let of = |module: &'static str| move |s: &&Spec| s.name.starts_with(module);
    let (base, exact): (Vec<_>, Vec<_>) = exact.iter().partition(of("base."));
    let (near, exact): (Vec<_>, Vec<_>) = exact.into_iter().partition(of("near."));
    let (quick, float): (Vec<_>, Vec<_>) = float.iter().partition(of("gg.quick."));
    exact.into_iter().for_each(|spec| file.exact_layer(spec));
    float.into_iter().for_each(|spec| file.float_layer(spec));
    base.into_iter().for_each(|spec| file.exact_layer(spec));
    near.into_iter().for_each(|spec| file.exact_layer(spec));
    quick.into_iter().for_each(|spec| file.float_layer(spec));
    // Half the features' range stands for ±4.
    let step = 1.0 / 256.0;
    file.put("g_scale", Dtype::F32, &[ROLES], [step; ROLES].map(f32::to_le_bytes));
    let c_scale = [0.0, step, step].map(f32::to_le_bytes);
    file.put("c_scale", Dtype::F32, &[ROLES], c_scale);
    for head in &shape.gg {
        let steps = vec![step.to_le_bytes(); head.scales()];
        let name = format!("{}.scale", head.module());
        file.put(&name, Dtype::F32, &[head.scales()], steps);
    }
    file.table("cdf.gauss", gauss_rows());
    file.table("cdf.prior", vec![row(3.0, 0.0); shape.latents]);
    file.file.write()
}

/// All layers of the exact zone, and all others.
fn layers(shape: &Shape) -> Result<[Vec<Spec>; 2]> {
    let (mut exact, mut float) = (Vec::new(), Vec::new());
    let list = |specs: &mut Vec<Spec>, spec: Spec| -> Result<()> {
        specs.push(spec);
        Ok(())
    };
    shape.exact(&mut |spec| list(&mut exact, spec))?;
    shape.generators(&mut |spec| list(&mut float, spec))?;
    shape.encoder(&mut |spec| list(&mut float, spec))?;
    Ok([exact, float])
}

struct File {
    random: u64,
    file: Container,
}

impl File {
    fn put<const N: usize>(
        &mut self,
        name: &str,
        dtype: Dtype,
        extents: &[usize],
        entries: impl IntoIterator<Item = [u8; N]>,
    ) {
        let bytes: Vec<u8> = entries.into_iter().flatten().collect();
        self.file.add(name, dtype, extents, &bytes);
    }

    /// SplitMix64, as an integer in ±limit.
    fn signed(&mut self, limit: i32) -> i32 {
        self.random = self.random.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.random;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z >> 32) % (2 * limit as u64 + 1)) as i32 - limit
    }

    /// A multiple of 1/1024 in ±1.
    fn unit(&mut self) -> f32 {
        self.signed(1024) as f32 / 1024.0
    }

    fn exact_layer(&mut self, spec: &Spec) {
        let Spec {
            name,
            volume,
            cin,
            cout,
            invariant,
        } = spec;
        let weights: Vec<_> = (0..volume * cin * cout).map(|_| self.signed(WEIGHT) as i16).collect();
        let extents = [*volume, *cin, *cout];
        self.put(
            &format!("{name}.weight"),
            Dtype::I16,
            &extents,
            weights.into_iter().map(i16::to_le_bytes),
        );
        let last = name.rsplit('.').next().unwrap_or_default();
        if *invariant {
            let gain = if matches!(last, "a2" | "b3") { 0.3 } else { 1.0 };
            let gain: Vec<_> = (0..*cout).map(|_| (gain + 0.1 * self.unit()).to_le_bytes()).collect();
            self.put(&format!("{name}.gain"), Dtype::F32, &[*cout], gain);
            let bias: Vec<_> = (0..*cout).map(|_| (50.0 * self.unit()).to_le_bytes()).collect();
            self.put(&format!("{name}.bias"), Dtype::F32, &[*cout], bias);
            return;
        }
        // A sum of n products by weights in ±127 has √(n·127²/3) times the deviation of the activations.
        let terms = taps_in_use(*volume) * cin;
        let keep = (terms * (WEIGHT * WEIGHT / 3) as usize).ilog2() / 2;
        let (shift, centre) = match last {
            "a2" | "b3" => (keep + 2, 0),
            "lin2" => (keep + 1, 0),
            "mu" => (keep + 4, 0),
            "sigma" if name.starts_with("near.") => (keep + 5, 0),
            "sigma" => (keep + 5, 28),
            _ => (keep, 0),
        };
        let bias: Vec<_> = (0..*cout)
            .map(|_| ((centre << shift) + (1 << (shift - 1)) + (self.signed(16) << (shift - 4))).to_le_bytes())
            .collect();
        self.put(&format!("{name}.bias"), Dtype::I32, &[*cout], bias);
        self.put(
            &format!("{name}.shift"),
            Dtype::U8,
            &[*cout],
            vec![[shift as u8]; *cout],
        );
    }

    fn float_layer(&mut self, spec: &Spec) {
        let Spec {
            name,
            volume,
            cin,
            cout,
            invariant,
        } = spec;
        let terms = taps_in_use(*volume) * cin;
        let last = name.rsplit('.').next().unwrap_or_default();
        let strength = match last {
            "conv_out" if name.starts_with("gg") => 0.3,
            "a2" | "b3" | "c2" => 0.3,
            "lin2" if name.starts_with("fs.0") => 16.0,
            "lin2" => 3.0,
            _ => 1.0,
        };
        let reach = (3.0 / terms as f32).sqrt() * if *invariant { 1.0 } else { strength };
        let weights: Vec<_> = (0..volume * cin * cout)
            .map(|_| f16::from_f32(reach * self.unit()).to_le_bytes())
            .collect();
        self.put(&format!("{name}.weight"), Dtype::F16, &[*volume, *cin, *cout], weights);
        if *invariant {
            let gain: Vec<_> = (0..*cout)
                .map(|_| (strength + 0.1 * self.unit()).to_le_bytes())
                .collect();
            self.put(&format!("{name}.gain"), Dtype::F32, &[*cout], gain);
        }
        let bias: Vec<_> = (0..*cout).map(|_| (0.1 * self.unit()).to_le_bytes()).collect();
        self.put(&format!("{name}.bias"), Dtype::F32, &[*cout], bias);
    }

    fn table(&mut self, name: &str, rows: Vec<(i16, Vec<u16>)>) {
        let mut offsets = vec![0u32];
        for (_, row) in &rows {
            offsets.push(offsets.last().unwrap_or(&0) + row.len() as u32);
        }
        let entries = rows.iter().flat_map(|(_, row)| row).map(|p| p.to_le_bytes());
        let count = offsets.last().map_or(0, |&n| n as usize);
        self.put(name, Dtype::U16, &[count], entries);
        let offsets = offsets.into_iter().map(u32::to_le_bytes);
        self.put(&format!("{name}.offset"), Dtype::U32, &[rows.len() + 1], offsets);
        let low = rows.iter().map(|(low, _)| low.to_le_bytes());
        self.put(&format!("{name}.low"), Dtype::I16, &[rows.len()], low);
    }
}

/// Taps that contribute to a typical sum: one octant's, or those that find a neighbour.
fn taps_in_use(volume: usize) -> usize {
    match volume {
        27 => TAPS_IN_USE,
        _ => 1,
    }
}

/// The rows of all scale indices, and within one of all sixteenths.
fn gauss_rows() -> Vec<(i16, Vec<u16>)> {
    // The 63rd root of 64 / 0.11, by bisection: the library's powers differ between machines.
    let power = |x: f64| (0..63).fold(1.0, |p, _| p * x);
    let (mut low, mut high) = (1.0, 2.0);
    for _ in 0..60 {
        let middle = (low + high) / 2.0;
        match power(middle) < 64.0 / 0.11 {
            true => low = middle,
            false => high = middle,
        }
    }
    let mut sigma = 0.11;
    let mut rows = Vec::new();
    for _ in 0..64 {
        rows.extend((-8..8).map(|fraction| row(sigma, f64::from(fraction) / 16.0)));
        sigma *= low;
    }
    rows
}

/// A table row of N(mean, sigma): the lowest value, and the probabilities of the values and of the escape in 2⁻¹⁶, less
/// 1 each.
fn row(sigma: f64, mean: f64) -> (i16, Vec<u16>) {
    let reach = ((5.0 * sigma) as i32 + 2).min(REACH);
    let below = |edge: f64| normal_cdf((edge - mean) / sigma);
    let mut masses: Vec<f64> = (-reach..=reach)
        .map(|d| below(f64::from(d) + 0.5) - below(f64::from(d) - 0.5))
        .collect();
    masses.push((1.0 - masses.iter().sum::<f64>()).max(0.0));
    let spare = 65536 - masses.len() as u32;
    let mut row: Vec<u16> = masses.iter().map(|mass| (mass * f64::from(spare)) as u16).collect();
    let rest = spare - row.iter().map(|&p| u32::from(p)).sum::<u32>();
    if let Some(largest) = row.iter_mut().max() {
        *largest += rest as u16;
    }
    (-reach as i16, row)
}

/// The standard normal distribution function by its power series, in arithmetic that is the same everywhere.
fn normal_cdf(x: f64) -> f64 {
    if x.abs() > 7.0 {
        return if x > 0.0 { 1.0 } else { 0.0 };
    }
    let (mut term, mut sum, mut n) = (x, x, 1.0);
    while term.abs() > 1e-18 {
        n += 2.0;
        term *= x * x / n;
        sum += term;
    }
    // e^(x²/2), by its series for a 64th of the exponent.
    let t = x * x / 128.0;
    let root = (1..20).rev().fold(1.0, |e, k| 1.0 + e * t / f64::from(k));
    let exponential = (0..6).fold(root, |e, _| e * e);
    0.5 + sum / exponential / (2.0 * std::f64::consts::PI).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::latents::network::{Model, Upsample};

    #[test]
    fn the_normal_distribution_has_its_textbook_values() {
        for (x, p) in [
            (0.0, 0.5),
            (1.0, 0.841_344_746_068_543),
            (-2.5, 0.006_209_665_325_776),
            (6.5, 0.999_999_999_959_84),
        ] {
            assert!((normal_cdf(x) - p).abs() < 1e-13, "{x}: {}", normal_cdf(x));
        }
        assert_eq!((normal_cdf(-9.0), normal_cdf(9.0)), (0.0, 1.0));
    }

    #[test]
    fn the_same_seed_gives_the_same_file_and_another_seed_another() {
        let shape = Shape::tiny();
        assert!(untrained(&shape, 1) == untrained(&shape, 1));
        assert!(untrained(&shape, 1) != untrained(&shape, 2));
    }

    #[test]
    fn made_up_models_load() {
        let wide = Shape {
            channels: 64,
            latents: 8,
            upsample: Upsample::Nearest,
            ..Shape::tiny()
        };
        for (seed, shape) in (1..).zip([Shape::tiny(), wide]) {
            let model = Model::from_bytes(&untrained(&shape, seed)).unwrap();
            assert_eq!(model.shape(), &shape);
            assert_eq!(model.tables().channels(), shape.latents);
            assert!(model.can_encode());
        }
    }
}
