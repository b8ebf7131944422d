//! The convolutions against their definitions, on every instruction set of this machine.

mod cases;
mod exact;
mod float;
mod half;
mod hostile;

use b2p_kernels::Isa;

/// All other tests run what is available: nothing that the processor has may be missing there.
#[test]
fn every_instruction_set_of_this_machine_is_tested() {
    let names: Vec<String> = Isa::available().iter().map(Isa::to_string).collect();
    println!("ran on {}", names.join(", "));
    #[cfg(target_arch = "x86_64")]
    let others = [
        (
            "avx2",
            is_x86_feature_detected!("avx2") && is_x86_feature_detected!("f16c"),
        ),
        ("avxvnni", is_x86_feature_detected!("avxvnni")),
        (
            "avx512",
            is_x86_feature_detected!("avx512vnni") && is_x86_feature_detected!("avx512bw"),
        ),
        ("amx", Isa::detect().has_tiles()),
    ];
    #[cfg(target_arch = "aarch64")]
    let others = [
        ("neon", true),
        ("dotprod", std::arch::is_aarch64_feature_detected!("dotprod")),
    ];
    #[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
    let others: [(&str, bool); 0] = [];
    let others = others.iter().filter(|(_, has)| *has).map(|(name, _)| *name);
    let expected: Vec<&str> = std::iter::once("scalar").chain(others).collect();
    assert_eq!(names, expected);
    let bf16 = Isa::detect().has_bf16();
    println!("bf16: {bf16}");
    #[cfg(target_arch = "x86_64")]
    assert_eq!(bf16, is_x86_feature_detected!("avx512bf16"));
    let half: Vec<String> = Isa::available()
        .iter()
        .filter(|isa| isa.has_half())
        .map(Isa::to_string)
        .collect();
    println!("half on {}", half.join(", "));
    #[cfg(target_arch = "aarch64")]
    if std::arch::is_aarch64_feature_detected!("fp16") {
        assert_eq!(half, names[1..], "all but plain code");
    }
    #[cfg(not(target_arch = "aarch64"))]
    assert!(half.is_empty());
}
