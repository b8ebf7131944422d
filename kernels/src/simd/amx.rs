//! AMX: matrix tiles, which kernels written by hand use.

use super::avx512::Bf16;

/// Proof of AMX with bytes and bf16, which the operating system lets this process use, and of AVX-512 and AVX512_BF16.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) struct Amx(Bf16);

impl Amx {
    /// The token, if processor and operating system have AMX. Asks once.
    pub fn new() -> Option<Amx> {
        static AMX: std::sync::OnceLock<bool> = std::sync::OnceLock::new();
        let bf16 = Bf16::new()?;
        AMX.get_or_init(has_amx).then_some(Amx(bf16))
    }
}

/// Whether there is AMX with bytes and bf16, on a processor that has AVX-512.
fn has_amx() -> bool {
    use std::arch::x86_64::{__cpuid, __cpuid_count, _xgetbv};
    const BF16_TILE_INT8: u32 = 1 << 22 | 1 << 24 | 1 << 25;
    const TILE_STATE: u64 = 1 << 17 | 1 << 18;
    if __cpuid(0).eax < 7 || __cpuid_count(7, 0).edx & BF16_TILE_INT8 != BF16_TILE_INT8 {
        return false;
    }
    // SAFETY: AVX-512, which was found before, is found only where the system saves registers by XSAVE.
    let saved = unsafe { _xgetbv(0) };
    saved & TILE_STATE == TILE_STATE && tiles_permitted()
}

/// Asks Linux for room for the tiles in this process's saved registers, which it grants once and for all threads.
#[cfg(target_os = "linux")]
fn tiles_permitted() -> bool {
    const ARCH_PRCTL: i64 = 158;
    const ARCH_REQ_XCOMP_PERM: i64 = 0x1023;
    const XTILEDATA: i64 = 18;
    let answer: i64;
    // SAFETY: a system call that reads and writes no memory of this process, with the registers that it may change
    // named.
    unsafe {
        std::arch::asm!(
            "syscall",
            inlateout("rax") ARCH_PRCTL => answer,
            in("rdi") ARCH_REQ_XCOMP_PERM,
            in("rsi") XTILEDATA,
            out("rcx") _,
            out("r11") _,
            options(nostack),
        );
    }
    answer == 0
}

/// Elsewhere it is not known how to ask.
#[cfg(not(target_os = "linux"))]
fn tiles_permitted() -> bool {
    false
}
