//! From an [`Isa`], known at run time, to code that is compiled for it.

use super::isa::Isa;
use super::vector::{Simd, Work};

impl Isa {
    /// Does work with this instruction set.
    pub fn run<W: Work>(self, work: W) -> W::Output {
        dispatch!(self, fn call<W: Work>(work: W) -> W::Output)
    }
}

#[inline(always)]
fn call<S: Simd, W: Work>(simd: S, work: W) -> W::Output {
    work.run(simd)
}

/// Calls `$body::<S, …>(token, args…)` in a function that is compiled with the features of `$isa`, whose token is of
/// type `S`.
///
/// Each compilation stays a function of its own, small enough for the compiler to find the vectors in it.
macro_rules! dispatch {
    ($isa:expr, $($body:tt)*) => {
        $crate::simd::instruction_sets! { match_level [$isa] ($($body)*) }
    };
}
pub(crate) use dispatch;

/// One arm for each instruction set.
macro_rules! match_level {
    ([$isa:expr] $body:tt $([$cfg:meta] $module:ident::$token:ident, $with:ident;)+) => {
        match $crate::simd::Isa::level($isa) {
            $(
                #[cfg($cfg)]
                $crate::simd::Level::$token(token) => {
                    $crate::simd::dispatch::compile! { [$module $token $with token] $body }
                }
            )+
        }
    };
}
pub(crate) use match_level;

/// Compiles a body for one instruction set, and calls it.
macro_rules! compile {
    (
        [$module:ident $token:ident $with:ident $proof:ident]
        (fn $body:ident $(<$($g:ident: $bound:path),* $(; const $n:ident: $n_ty:ty)?>)?
        ($($arg:ident: $ty:ty),* $(,)?) $(-> $out:ty)?)
    ) => {{
        $crate::simd::$module::$with! {
            fn compiled $(<$($g: $bound,)* $(const $n: $n_ty)?>)?
                (token: $crate::simd::$module::$token, $($arg: $ty),*) $(-> $out)? {
                $body $(::<_, $($g,)* $($n)?>)? (token, $($arg),*)
            }
        }
        // SAFETY: the token proves the features.
        #[allow(unused_unsafe, reason = "portable code has no features")]
        unsafe { compiled $(::<$($g,)* $($n)?>)? ($proof, $($arg),*) }
    }};
}
pub(crate) use compile;
