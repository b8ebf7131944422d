//! What must be refused.

use b2p_kernels::f16;
use b2p_kernels::{ABSENT, ExactConv, FloatConv, Isa, Requantise, Scale, Taps};

use crate::cases::whole;

#[test]
#[should_panic(expected = "another kernel")]
fn taps_of_another_kernel_are_refused() {
    let conv = ExactConv::new(
        1,
        1,
        1,
        &[1],
        Requantise::Shift {
            bias: vec![0],
            shift: vec![0],
        },
    );
    conv.run(Isa::SCALAR, Taps::Children, &[1], 0, whole(&mut [0; 8], 1, None, false));
}

#[test]
fn a_tap_that_reads_beyond_the_input_panics_on_every_isa() {
    let float = FloatConv::new(2, 4, 4, &[f16::ONE; 32], vec![0.0; 4], Scale::Plain);
    let shift = Requantise::Shift {
        bias: vec![0; 4],
        shift: vec![0; 4],
    };
    let exact = ExactConv::new(2, 4, 4, &[1; 32], shift);
    for isa in Isa::available() {
        for bad in [3, 1 << 20, u32::MAX - 1] {
            for place in [0, 1, 299, 300, 599] {
                let mut map = vec![ABSENT; 600];
                map[place] = bad;
                let taps = Taps::Map {
                    volume: 2,
                    rows: &map,
                    plan: None,
                };
                let refused = [
                    std::panic::catch_unwind(|| {
                        let mut rows = [0i16; 1200];
                        let output = whole(&mut rows, 4, None, false);
                        exact.run(isa, taps, &[1; 12], 0, output);
                    }),
                    std::panic::catch_unwind(|| {
                        let mut rows = [f16::ZERO; 1200];
                        let output = whole(&mut rows, 4, None, false);
                        float.run(isa, taps, &[f16::ONE; 12], 0, output);
                    }),
                ];
                assert!(refused.iter().all(Result::is_err), "{isa}: {bad} at {place}");
            }
        }
    }
}
