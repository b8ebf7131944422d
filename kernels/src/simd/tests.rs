//! Every operation of the vectors of every instruction set, beside those of [`Scalar`].

use proptest::prelude::*;

use half::f16;

use super::{F32Vector, F64Vector, I16Vector, I32Vector, Isa, MaskVector, Scalar, Simd, Work};

/// Values of the longest vectors.
const LONGEST: usize = 32;

/// What to compute with: as many of each, whole vectors.
#[derive(Debug, Clone)]
struct Arguments {
    a: Vec<f32>,
    b: Vec<f32>,
    c: Vec<f32>,
    i: Vec<i32>,
    j: Vec<i32>,
    p: Vec<i16>,
    q: Vec<i16>,
    bytes: Vec<i8>,
    halves: Vec<f16>,
    count: u32,
}

/// The results of an operation for all lanes.
#[derive(Debug, Clone, PartialEq)]
enum Lanes {
    /// To the bit, but any NaN is like another.
    F32(Vec<f32>),
    /// To a relative error of 2⁻²⁰ of the greatest term.
    Near(Vec<f32>),
    I32(Vec<i32>),
    I16(Vec<i16>),
    F16(Vec<f16>),
    Bits(Vec<bool>),
}

/// All operations, by their names.
struct Every<'a>(&'a Arguments);

impl Work for Every<'_> {
    type Output = Vec<(&'static str, Lanes)>;

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> Self::Output {
        let x = self.0;
        let mut all = floats(s, x);
        all.extend(masks(s, x));
        all.extend(doubles(s, x));
        all.extend(integers(s, x));
        all.extend(shorts(s, x));
        all.extend(moves(s, x));
        all
    }
}

/// Collects `$e`, a vector for each place `$at`, by `$store`.
macro_rules! collect {
    ($kind:ident, $zero:expr, $lanes:expr, $x:expr, |$at:ident| $e:expr) => {{
        let mut to = vec![$zero; $x.a.len()];
        for $at in (0..to.len()).step_by($lanes) {
            $e.store(&mut to[$at..]);
        }
        Lanes::$kind(to)
    }};
}

/// As [`collect`], of masks.
macro_rules! collect_mask {
    ($lanes:expr, $x:expr, |$at:ident| $e:expr) => {{
        let mut to = Vec::new();
        for $at in (0..$x.a.len()).step_by($lanes) {
            let bits = $e.bits();
            to.extend((0..$lanes).map(|lane| bits >> lane & 1 == 1));
            assert!(u64::from(bits) >> $lanes == 0, "no bits beyond the lanes");
        }
        Lanes::Bits(to)
    }};
}

#[inline(always)]
fn floats<S: Simd>(s: S, x: &Arguments) -> Vec<(&'static str, Lanes)> {
    let n = S::LANES;
    let a = |at: usize| S::F32::load(s, &x.a[at..]);
    let b = |at: usize| S::F32::load(s, &x.b[at..]);
    let c = |at: usize| S::F32::load(s, &x.c[at..]);
    // For logarithms and whole numbers.
    let positive = |at: usize| {
        a(at)
            .abs()
            .max(S::F32::splat(s, f32::MIN_POSITIVE))
            .min(S::F32::splat(s, f32::MAX))
    };
    let small = |at: usize| a(at).min(S::F32::splat(s, 4e6)).max(S::F32::splat(s, -4e6));
    let power = |at: usize| a(at).min(S::F32::splat(s, 1.0)).max(S::F32::splat(s, -126.0));
    vec![
        (
            "splat",
            collect!(F32, 0.0, n, x, |at| S::F32::splat(s, x.a[at / 16 * 16])),
        ),
        ("add", collect!(F32, 0.0, n, x, |at| a(at) + b(at))),
        ("sub", collect!(F32, 0.0, n, x, |at| a(at) - b(at))),
        ("mul", collect!(F32, 0.0, n, x, |at| a(at) * b(at))),
        ("div", collect!(F32, 0.0, n, x, |at| a(at) / b(at))),
        (
            "mul_add",
            collect!(Near, 0.0, n, x, |at| c(at).mul_add(c(at), S::F32::splat(s, 1.0))),
        ),
        (
            "neg_mul_add",
            // Both terms have one sign: what cancels would magnify the rounding of the product.
            collect!(Near, 0.0, n, x, |at| c(at).neg_mul_add(c(at), S::F32::splat(s, -1.0))),
        ),
        ("sqrt", collect!(F32, 0.0, n, x, |at| a(at).sqrt())),
        ("abs", collect!(F32, 0.0, n, x, |at| a(at).abs())),
        ("min", collect!(F32, 0.0, n, x, |at| a(at).min(b(at)))),
        ("max", collect!(F32, 0.0, n, x, |at| a(at).max(b(at)))),
        (
            "ceil",
            collect!(F32, 0.0, n, x, |at| small(at).ceil() + S::F32::splat(s, 0.0)),
        ),
        (
            "floor",
            collect!(F32, 0.0, n, x, |at| small(at).floor() + S::F32::splat(s, 0.0)),
        ),
        ("exp2", collect!(Near, 0.0, n, x, |at| power(at).exp2())),
        (
            "mantissa",
            collect!(F32, 0.0, n, x, |at| positive(at).split_exponent().0),
        ),
        (
            "exponent",
            collect!(F32, 0.0, n, x, |at| positive(at).split_exponent().1),
        ),
        ("round_to_i32", collect!(I32, 0, n, x, |at| small(at).round_to_i32())),
        (
            "truncate_to_i32",
            collect!(I32, 0, n, x, |at| small(at).truncate_to_i32()),
        ),
        ("to_bits", collect!(I32, 0, n, x, |at| c(at).to_bits())),
    ]
}

#[inline(always)]
fn masks<S: Simd>(s: S, x: &Arguments) -> Vec<(&'static str, Lanes)> {
    let n = S::LANES;
    let a = |at: usize| S::F32::load(s, &x.a[at..]);
    let b = |at: usize| S::F32::load(s, &x.b[at..]);
    let i = |at: usize| S::I32::load(s, &x.i[at..]);
    let j = |at: usize| S::I32::load(s, &x.j[at..]);
    vec![
        ("lt", collect_mask!(n, x, |at| a(at).lt(b(at)))),
        ("le", collect_mask!(n, x, |at| a(at).le(b(at)))),
        ("ordered", collect_mask!(n, x, |at| a(at).ordered(b(at)))),
        ("and", collect_mask!(n, x, |at| a(at).lt(b(at)).and(i(at).lt(j(at))))),
        ("eq of i32", collect_mask!(n, x, |at| i(at).eq(j(at)))),
        ("lt of i32", collect_mask!(n, x, |at| i(at).lt(j(at)))),
        (
            "select",
            collect!(F32, 0.0, n, x, |at| S::F32::select(i(at).lt(j(at)), a(at), b(at))),
        ),
        ("keep", collect!(F32, 0.0, n, x, |at| a(at).keep(i(at).lt(j(at))))),
        (
            "select of i32",
            collect!(I32, 0, n, x, |at| S::I32::select(a(at).lt(b(at)), i(at), j(at))),
        ),
        ("keep of i32", collect!(I32, 0, n, x, |at| i(at).keep(a(at).lt(b(at))))),
    ]
}

#[inline(always)]
fn doubles<S: Simd>(s: S, x: &Arguments) -> Vec<(&'static str, Lanes)> {
    let n = S::LANES;
    let a = |at: usize| S::F64::from_f32(S::F32::load(s, &x.a[at..]));
    let b = |at: usize| S::F64::from_f32(S::F32::load(s, &x.b[at..]));
    let c = |at: usize| S::F64::from_f32(S::F32::load(s, &x.c[at..]));
    let third = S::F64::splat(s, 1.0 / 3.0);
    vec![
        (
            "mul of f64",
            collect!(F32, 0.0, n, x, |at| (a(at) * third * b(at)).to_f32()),
        ),
        (
            "div of f64",
            collect!(F32, 0.0, n, x, |at| (a(at) * third / b(at)).to_f32()),
        ),
        (
            "mul_add of f64",
            collect!(Near, 0.0, n, x, |at| c(at).mul_add(c(at), third).to_f32()),
        ),
        ("min of f64", collect!(F32, 0.0, n, x, |at| a(at).min(b(at)).to_f32())),
        ("max of f64", collect!(F32, 0.0, n, x, |at| a(at).max(b(at)).to_f32())),
        ("lt of f64", collect_mask!(n, x, |at| a(at).lt(b(at)))),
    ]
}

#[inline(always)]
fn integers<S: Simd>(s: S, x: &Arguments) -> Vec<(&'static str, Lanes)> {
    let n = S::LANES;
    let i = |at: usize| S::I32::load(s, &x.i[at..]);
    let j = |at: usize| S::I32::load(s, &x.j[at..]);
    let p = |at: usize| S::I16::load(s, &x.p[2 * at..]);
    let q = |at: usize| S::I16::load(s, &x.q[2 * at..]);
    let count = x.count;
    let sums = |at: usize| {
        // Of as many lanes in every set.
        let sums = (at..at + LONGEST).step_by(n).map(|at| i(at).sum());
        sums.fold(0i32, i32::wrapping_add)
    };
    let sums = (0..x.i.len()).step_by(LONGEST).map(sums).collect();
    vec![
        (
            "splat of i32",
            collect!(I32, 0, n, x, |at| S::I32::splat(s, x.i[at / 16 * 16])),
        ),
        ("add of i32", collect!(I32, 0, n, x, |at| i(at) + j(at))),
        ("sub of i32", collect!(I32, 0, n, x, |at| i(at) - j(at))),
        ("mul of i32", collect!(I32, 0, n, x, |at| i(at) * j(at))),
        ("bitand", collect!(I32, 0, n, x, |at| i(at) & j(at))),
        ("bitor", collect!(I32, 0, n, x, |at| i(at) | j(at))),
        ("min of i32", collect!(I32, 0, n, x, |at| i(at).min(j(at)))),
        ("max of i32", collect!(I32, 0, n, x, |at| i(at).max(j(at)))),
        ("min_unsigned", collect!(I32, 0, n, x, |at| i(at).min_unsigned(j(at)))),
        ("abs of i32", collect!(I32, 0, n, x, |at| i(at).abs())),
        ("shl", collect!(I32, 0, n, x, |at| i(at).shl(count))),
        ("shr", collect!(I32, 0, n, x, |at| i(at).shr(count))),
        ("shr_unsigned", collect!(I32, 0, n, x, |at| i(at).shr_unsigned(count))),
        (
            "shr_each",
            collect!(I32, 0, n, x, |at| i(at).shr_each(j(at) & S::I32::splat(s, 31))),
        ),
        ("dot_pairs", collect!(I32, 0, n, x, |at| i(at).dot_pairs(p(at), q(at)))),
        ("to_f32", collect!(F32, 0.0, n, x, |at| i(at).to_f32())),
        ("as_f32", collect!(F32, 0.0, n, x, |at| i(at).as_f32())),
        ("load_i16", collect!(I32, 0, n, x, |at| S::I32::load_i16(s, &x.p[at..]))),
        ("as_i32", collect!(I32, 0, n, x, |at| p(at).as_i32())),
        ("sum", Lanes::I32(sums)),
    ]
}

#[inline(always)]
fn shorts<S: Simd>(s: S, x: &Arguments) -> Vec<(&'static str, Lanes)> {
    let n = 2 * S::LANES;
    let p = |at: usize| S::I16::load(s, &x.p[at..]);
    let q = |at: usize| S::I16::load(s, &x.q[at..]);
    let count = x.count % 16;
    let mut narrowed = vec![0; x.a.len()];
    for at in (0..narrowed.len()).step_by(S::LANES) {
        S::I32::load(s, &x.i[at..]).store_i16(&mut narrowed[at..]);
    }
    vec![
        (
            "splat of i16",
            collect!(I16, 0, n, x, |at| S::I16::splat(s, x.p[at / LONGEST * LONGEST])),
        ),
        ("add of i16", collect!(I16, 0, n, x, |at| p(at) + q(at))),
        ("sub of i16", collect!(I16, 0, n, x, |at| p(at) - q(at))),
        (
            "saturating_add",
            collect!(I16, 0, n, x, |at| p(at).saturating_add(q(at))),
        ),
        ("min of i16", collect!(I16, 0, n, x, |at| p(at).min(q(at)))),
        ("max of i16", collect!(I16, 0, n, x, |at| p(at).max(q(at)))),
        ("mul_high", collect!(I16, 0, n, x, |at| p(at).mul_high(q(at)))),
        ("shr of i16", collect!(I16, 0, n, x, |at| p(at).shr(count))),
        (
            "load_i8",
            collect!(I16, 0, n, x, |at| S::I16::load_i8(s, &x.bytes[at..])),
        ),
        (
            "as_i16",
            collect!(I16, 0, n, x, |at| S::I32::load(s, &x.i[at / 2..]).as_i16()),
        ),
        ("store_i16", Lanes::I16(narrowed)),
    ]
}

/// What moves values between lanes, and in and out of memory.
#[inline(always)]
fn moves<S: Simd>(s: S, x: &Arguments) -> Vec<(&'static str, Lanes)> {
    let n = S::LANES;
    let len = x.a.len();
    let mut halves = vec![f16::ZERO; len];
    let (mut threes, mut fours) = (vec![0.0; 3 * len], vec![0.0; 4 * len]);
    let mut kept = Vec::new();
    for at in (0..len).step_by(n) {
        S::F32::load(s, &x.a[at..]).store_f16(&mut halves[at..]);
        let from: Vec<[f32; 3]> = (at..at + n).map(|i| [x.a[i], x.b[i], x.c[i]]).collect();
        for (k, vector) in S::F32::load_deinterleaved3(s, &from).into_iter().enumerate() {
            vector.store(&mut threes[k * len + at..]);
        }
        let from: Vec<[f32; 4]> = (at..at + n).map(|i| [x.a[i], x.b[i], x.c[i], x.a[i]]).collect();
        for (k, vector) in S::F32::load_deinterleaved4(s, &from).into_iter().enumerate() {
            vector.store(&mut fours[k * len + at..]);
        }
        let which = (at..at + n).fold(0u32, |which, i| which | u32::from(x.i[i] & 1 == 1) << (i - at));
        let mut first = [0.0; 16];
        S::F32::load(s, &x.a[at..]).compress(which).store(&mut first);
        kept.extend(&first[..which.count_ones() as usize]);
    }
    let wide = collect!(F32, 0.0, n, x, |at| S::F32::load_f16(s, &x.halves[at..]));
    let [fields, back] = records(s, x);
    vec![
        ("store_f16", Lanes::F16(halves)),
        ("load_f16", wide),
        ("load_deinterleaved3", Lanes::F32(threes)),
        ("load_deinterleaved4", Lanes::F32(fours)),
        ("compress", Lanes::F32(kept)),
        ("load_records", Lanes::F32(fields)),
        ("store_records", Lanes::F32(back)),
    ]
}

/// Records made of the arguments as vectors of fields, and those of odd numbers as records again.
#[inline(always)]
fn records<S: Simd>(s: S, x: &Arguments) -> [Vec<f32>; 2] {
    let len = x.a.len();
    let record = |i: usize| std::array::from_fn(|k| x.a[i] + k as f32);
    let (mut fields, mut back) = (vec![0.0; 16 * len], Vec::new());
    for at in (0..len).step_by(S::LANES) {
        let from: Vec<[f32; 16]> = (at..at + S::LANES).map(record).collect();
        let from: Vec<&[f32; 16]> = from.iter().collect();
        let vectors = S::F32::load_records(s, &from);
        for (k, vector) in vectors.iter().enumerate() {
            vector.store(&mut fields[k * len + at..]);
        }
        let which = (at..at + S::LANES).fold(0u32, |which, i| which | u32::from(x.i[i] & 1 == 1) << (i - at));
        let mut to = [[0.0; 16]; 16];
        let kept = S::F32::store_records(&vectors, which, &mut to);
        assert_eq!(kept, which.count_ones() as usize);
        back.extend_from_slice(to[..kept].as_flattened());
    }
    [fields, back]
}

/// Whether two results are the same, as far as [`Lanes`] says.
fn alike(a: &Lanes, b: &Lanes) -> bool {
    match (a, b) {
        (Lanes::F32(a), Lanes::F32(b)) => {
            let same = |(a, b): (&f32, &f32)| a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan();
            a.len() == b.len() && a.iter().zip(b).all(same)
        }
        (Lanes::Near(a), Lanes::Near(b)) => {
            let near = |(a, b): (&f32, &f32)| (a - b).abs() <= a.abs().max(f32::MIN_POSITIVE) * 7e-6 || a == b;
            a.len() == b.len() && a.iter().zip(b).all(near)
        }
        (a, b) => a == b,
    }
}

fn a_float() -> impl Strategy<Value = f32> {
    let special = [
        0.0,
        -0.0,
        1.0,
        -126.0,
        0.5,
        1.5,
        2.5,
        -2.5,
        f32::NAN,
        f32::INFINITY,
        f32::NEG_INFINITY,
        65504.0,
        65520.0,
    ];
    prop_oneof![any::<f32>(), -130f32..130.0, prop::sample::select(special.to_vec())]
}

fn an_integer() -> impl Strategy<Value = i32> {
    prop_oneof![any::<i32>(), -40_000..40_000, Just(i32::MIN), Just(i32::MAX)]
}

fn a_short() -> impl Strategy<Value = i16> {
    prop_oneof![any::<i16>(), Just(i16::MIN), Just(i16::MAX)]
}

prop_compose! {
    /// As many values as none to three of the longest vectors hold.
    fn arguments()(vectors in 0usize..=3)(
        a in prop::collection::vec(a_float(), LONGEST * vectors),
        b in prop::collection::vec(a_float(), LONGEST * vectors),
        c in prop::collection::vec(-1000f32..1000.0, LONGEST * vectors),
        i in prop::collection::vec(an_integer(), LONGEST * vectors),
        j in prop::collection::vec(an_integer(), LONGEST * vectors),
        p in prop::collection::vec(a_short(), 2 * LONGEST * vectors),
        q in prop::collection::vec(a_short(), 2 * LONGEST * vectors),
        bytes in prop::collection::vec(any::<i8>(), LONGEST * vectors),
        halves in prop::collection::vec(any::<u16>().prop_map(f16::from_bits), LONGEST * vectors),
        count in 0u32..32,
    ) -> Arguments {
        Arguments { a, b, c, i, j, p, q, bytes, halves, count }
    }
}

proptest! {
    #[test]
    fn every_instruction_set_computes_what_portable_code_does(arguments in arguments()) {
        let expected = Every(&arguments).run(Scalar::TOKEN);
        for isa in Isa::available() {
            let results = isa.run(Every(&arguments));
            prop_assert_eq!(results.len(), expected.len());
            for ((name, got), (_, expected)) in results.iter().zip(&expected) {
                prop_assert!(alike(got, expected), "{name} with {isa}: {got:?} is not {expected:?}");
            }
        }
    }
}

#[test]
fn a_vector_is_not_loaded_from_fewer_values() {
    struct Load;
    impl Work for Load {
        type Output = ();

        #[inline(always)]
        fn run<S: Simd>(self, simd: S) {
            let short = vec![0.0; S::LANES - 1];
            S::F32::load(simd, &short);
        }
    }
    for isa in Isa::available() {
        assert!(std::panic::catch_unwind(|| isa.run(Load)).is_err(), "{isa}");
    }
}

/// Sums of products, in plain code.
struct Sum<'a>(&'a [i16], &'a [i16]);

impl Work for Sum<'_> {
    type Output = i32;

    #[inline(always)]
    fn run<S: Simd>(self, _: S) -> i32 {
        let products = self.0.iter().zip(self.1);
        products.fold(0, |sum, (&a, &b)| sum.wrapping_add(i32::from(a) * i32::from(b)))
    }
}

#[test]
fn work_comes_to_the_same_on_every_instruction_set() {
    let a: Vec<i16> = (0..1000).map(|i| (i * 7919 % 65_536) as u16 as i16).collect();
    let b: Vec<i16> = a.iter().rev().copied().collect();
    let expected = Sum(&a, &b).run(Scalar::TOKEN);
    for isa in Isa::available() {
        assert_eq!(isa.run(Sum(&a, &b)), expected, "{isa}");
    }
}
