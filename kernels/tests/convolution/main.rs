//! The convolutions against their definitions, on every instruction set of this machine.

mod cases;
mod exact;
mod float;
mod hostile;

use b2p_kernels::Isa;

/// All other tests run what is available: nothing that the processor has may be missing there.
#[test]
fn every_instruction_set_of_this_machine_is_tested() {
    let names: Vec<String> = Isa::available().iter().map(Isa::to_string).collect();
    println!("ran on {}", names.join(", "));
    let mut expected = vec!["scalar"];
    #[cfg(target_arch = "x86_64")]
    {
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("f16c") {
            expected.push("avx2");
        }
        if is_x86_feature_detected!("avx512vnni") && is_x86_feature_detected!("avx512bw") {
            expected.push("avx512");
        }
        if Isa::detect().has_tiles() {
            expected.push("amx");
        }
    }
    #[cfg(target_arch = "aarch64")]
    expected.push("neon");
    assert_eq!(names, expected);
    let bf16 = Isa::detect().has_bf16();
    println!("bf16: {bf16}");
    #[cfg(target_arch = "x86_64")]
    assert_eq!(bf16, is_x86_feature_detected!("avx512bf16"));
}
