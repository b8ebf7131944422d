//! From an [`Isa`], known at run time, to code that is compiled for it; and what the files of the instruction sets share.

use super::{Isa, Simd};

/// Work that is compiled once for every instruction set.
///
/// What it calls must be inlined into it (`#[inline(always)]`, closures): a function that is not is compiled for the baseline of the
/// target. Results are the same in all sets, as integers are everywhere, and floats whose order of operations is written down.
pub trait Work {
    /// The result.
    type Output;

    /// Does the work with an instruction set; `#[inline(always)]` in implementations.
    fn run<S: Simd>(self, simd: S) -> Self::Output;
}

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

/// Calls `$body::<S, …>(token, args…)` in a function that is compiled with the features of `$isa`, whose token is of type `S`.
///
/// Each compilation stays a function of its own, small enough for the compiler to find the vectors in it.
macro_rules! dispatch {
    (
        $isa:expr,
        fn $body:ident $(<$($g:ident: $bound:path),* $(; const $n:ident: $n_ty:ty)?>)?
        ($($arg:ident: $ty:ty),* $(,)?) $(-> $out:ty)?
    ) => {{
        #[inline(never)]
        fn scalar $(<$($g: $bound,)* $(const $n: $n_ty)?>)?
            (token: $crate::simd::Scalar, $($arg: $ty),*) $(-> $out)? {
            $body $(::<_, $($g,)* $($n)?>)? (token, $($arg),*)
        }
        #[cfg(target_arch = "x86_64")]
        $crate::simd::avx2::with_avx2! {
            fn avx2 $(<$($g: $bound,)* $(const $n: $n_ty)?>)?
                (token: $crate::simd::Avx2, $($arg: $ty),*) $(-> $out)? {
                $body $(::<_, $($g,)* $($n)?>)? (token, $($arg),*)
            }
        }
        #[cfg(target_arch = "x86_64")]
        $crate::simd::avx512::with_avx512! {
            fn avx512 $(<$($g: $bound,)* $(const $n: $n_ty)?>)?
                (token: $crate::simd::Avx512, $($arg: $ty),*) $(-> $out)? {
                $body $(::<_, $($g,)* $($n)?>)? (token, $($arg),*)
            }
        }
        #[cfg(target_arch = "aarch64")]
        $crate::simd::neon::with_neon! {
            fn neon $(<$($g: $bound,)* $(const $n: $n_ty)?>)?
                (token: $crate::simd::Neon, $($arg: $ty),*) $(-> $out)? {
                $body $(::<_, $($g,)* $($n)?>)? (token, $($arg),*)
            }
        }
        match $crate::simd::Isa::level($isa) {
            $crate::simd::Level::Scalar(token) => scalar $(::<$($g,)* $($n)?>)? (token, $($arg),*),
            #[cfg(target_arch = "x86_64")]
            $crate::simd::Level::Avx2(token) | $crate::simd::Level::AvxVnni(_, token) => {
                // SAFETY: the token proves the features.
                unsafe { avx2 $(::<$($g,)* $($n)?>)? (token, $($arg),*) }
            }
            #[cfg(target_arch = "x86_64")]
            $crate::simd::Level::Avx512(token) | $crate::simd::Level::Amx(_, token) => {
                // SAFETY: the token proves the features.
                unsafe { avx512 $(::<$($g,)* $($n)?>)? (token, $($arg),*) }
            }
            #[cfg(target_arch = "aarch64")]
            $crate::simd::Level::Neon(token) | $crate::simd::Level::NeonDot(_, token) => {
                // SAFETY: the token proves the features.
                unsafe { neon $(::<$($g,)* $($n)?>)? (token, $($arg),*) }
            }
        }
    }};
}
pub(crate) use dispatch;

/// Names the features of an instruction set, once: defines a token that can only be had where the processor has them, and a macro
/// that compiles functions with them. A set may extend another one.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
macro_rules! define_set {
    (
        $dollar:tt $with:ident, $detect:ident, $(#[$doc:meta])* $visible:vis struct $token:ident = $($feature:tt),+;
        $(extends $module:ident::$base:ident, $with_base:ident;)?
    ) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        $visible struct $token(());

        impl $token {
            /// The token, if the processor has all features of the set.
            $visible fn new() -> Option<Self> {
                let all = true $(&& std::arch::$detect!($feature))+ $(&& $crate::simd::$module::$base::new().is_some())?;
                all.then_some(Self(()))
            }
        }

        $crate::simd::dispatch::feature_macro! { $dollar $with [$($module::$with_base)?] $($feature),+ }
    };
}
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
pub(crate) use define_set;

/// Defines a macro that compiles functions with features, and with those of another such macro if there is one.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
macro_rules! feature_macro {
    ($dollar:tt $with:ident [] $($feature:tt),+) => {
        /// Compiles a function with the features of the set.
        #[allow(unused_macros, reason = "as below")]
        macro_rules! $with {
            ($dollar($dollar item:tt)*) => {
                $(#[target_feature(enable = $feature)])+
                $dollar($dollar item)*
            };
        }
        #[allow(unused_imports, reason = "not all sets are used outside their file, or without features")]
        pub(crate) use $with;
    };
    ($dollar:tt $with:ident [$module:ident::$base:ident] $($feature:tt),+) => {
        /// Compiles a function with the features of the set.
        #[allow(unused_macros, reason = "as below")]
        macro_rules! $with {
            ($dollar($dollar item:tt)*) => {
                $crate::simd::$module::$base! {
                    $(#[target_feature(enable = $feature)])+
                    $dollar($dollar item)*
                }
            };
        }
        #[allow(unused_imports, reason = "not all sets are used outside their file, or without features")]
        pub(crate) use $with;
    };
}
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
pub(crate) use feature_macro;

/// Implements a trait of vectors by functions that are compiled with the features of an instruction set. Their bodies are safe code.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
macro_rules! methods {
    ($with:ident $vector:ident: $trait:path {
        $(type $output:ident = $output_type:ty;)*
        $(const $constant:ident: $constant_type:ty = $value:expr;)?
        $(fn $name:ident($first:ident $(: $first_ty:ty)? $(, $arg:ident: $ty:ty)* $(,)?) $(-> $out:ty)? $body:block)*
    }) => {
        impl $vector {
            $($with! {
                #[inline]
                fn $name($first $(: $first_ty)? $(, $arg: $ty)*) $(-> $out)? $body
            })*
        }

        impl $trait for $vector {
            $(type $output = $output_type;)*
            $(const $constant: $constant_type = $value;)?
            $(#[inline(always)]
            fn $name($first $(: $first_ty)? $(, $arg: $ty)*) $(-> $out)? {
                // SAFETY: among the arguments is the set's token, or a vector, which is only made from the token or other vectors.
                unsafe { <$vector>::$name($first $(, $arg)*) }
            })*
        }
    };
}
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
pub(crate) use methods;

/// Implements operators that are one instruction each.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
macro_rules! operators {
    ($vector:ident: $($operator:ident::$name:ident = $instruction:ident),* $(,)?) => {
        $(impl std::ops::$operator for $vector {
            type Output = Self;

            #[inline(always)]
            fn $name(self, other: Self) -> Self {
                // SAFETY: a vector is only made from the set's token or other vectors.
                Self(unsafe { $instruction(self.0, other.0) })
            }
        })*
    };
}
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
pub(crate) use operators;
