//! What the files of the instruction sets, and bodies over any vectors, are written with.

/// `[$e; 3]` with `$i` counting. Arrays' own `map` and `from_fn` are calls that the compiler does not always inline
/// into code for an instruction set above the baseline; so are closures.
macro_rules! three {
    ($i:ident => $e:expr) => {
        [
            {
                let $i = 0;
                $e
            },
            {
                let $i = 1;
                $e
            },
            {
                let $i = 2;
                $e
            },
        ]
    };
}
pub(crate) use three;

/// As [`three`].
macro_rules! four {
    ($i:ident => $e:expr) => {
        [
            {
                let $i = 0;
                $e
            },
            {
                let $i = 1;
                $e
            },
            {
                let $i = 2;
                $e
            },
            {
                let $i = 3;
                $e
            },
        ]
    };
}
pub(crate) use four;

/// As [`three`].
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64", target_feature = "simd128"))]
macro_rules! five {
    ($i:ident => $e:expr) => {{
        let [a, b, c, d] = $crate::simd::macros::four!($i => $e);
        let $i = 4;
        [a, b, c, d, $e]
    }};
}
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64", target_feature = "simd128"))]
pub(crate) use five;

/// Names the features of an instruction set, once: defines a token that can only be had where the processor has them,
/// and a macro that compiles functions with them. A set may extend another one.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
macro_rules! define_set {
    ($dollar:tt $with:ident, $detect:ident, $(#[$doc:meta])* $visible:vis struct $token:ident = $($feature:tt),+;) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        $visible struct $token(());

        impl $token {
            /// The token, if the processor has all features of the set.
            $visible fn new() -> Option<Self> {
                let all = true $(&& std::arch::$detect!($feature))+;
                all.then_some(Self(()))
            }
        }

        $crate::simd::macros::feature_macro! { $dollar $with [] $($feature),+ }
    };
    (
        $dollar:tt $with:ident, $detect:ident, $(#[$doc:meta])* $visible:vis struct $token:ident = $($feature:tt),+;
        extends $module:ident::$base:ident, $with_base:ident;
    ) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        $visible struct $token($crate::simd::$module::$base);

        impl $token {
            /// The token, if the processor has all features of the set.
            $visible fn new() -> Option<Self> {
                let base = $crate::simd::$module::$base::new()?;
                let all = true $(&& std::arch::$detect!($feature))+;
                all.then_some(Self(base))
            }

            /// The proof of the set that this one extends.
            #[inline(always)]
            #[allow(dead_code, reason = "not all sets that are extended are asked for")]
            pub(crate) fn base(self) -> $crate::simd::$module::$base {
                self.0
            }
        }

        $crate::simd::macros::feature_macro! { $dollar $with [$module::$with_base] $($feature),+ }
    };
}
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
pub(crate) use define_set;

/// Lets a token run work in a function that is compiled with the features of its set, with the token that `$proof`
/// names.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
macro_rules! vectorize {
    ($with:ident $token:ident, $proof:ident: $type:ty) => {
        impl $token {
            /// Runs `work` in a function that is compiled with the features of this set.
            #[inline(always)]
            pub(crate) fn vectorize<W: $crate::simd::vector::Work>(self, work: W) -> W::Output {
                $with! {
                    fn run<W: $crate::simd::vector::Work>(token: $type, work: W) -> W::Output {
                        work.run(token)
                    }
                }
                // SAFETY: the token proves the features.
                unsafe { run(self.$proof(), work) }
            }
        }
    };
}
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
pub(crate) use vectorize;

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

/// Implements a trait of vectors by functions that are compiled with the features of an instruction set. Their bodies
/// are safe code.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64", target_feature = "simd128"))]
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
                // SAFETY: among the arguments is the set's token, or a vector, which is only made from the token or
                // other vectors.
                #[allow(unused_unsafe, reason = "WebAssembly's features are those of the module")]
                unsafe { <$vector>::$name($first $(, $arg)*) }
            })*
        }
    };
}
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64", target_feature = "simd128"))]
pub(crate) use methods;

/// Implements operators that are one instruction each.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64", target_feature = "simd128"))]
macro_rules! operators {
    ($vector:ident: $($operator:ident::$name:ident = $instruction:ident),* $(,)?) => {
        $(impl std::ops::$operator for $vector {
            type Output = Self;

            #[inline(always)]
            fn $name(self, other: Self) -> Self {
                // SAFETY: a vector is only made from the set's token or other vectors.
                #[allow(unused_unsafe, reason = "WebAssembly's features are those of the module")]
                Self(unsafe { $instruction(self.0, other.0) })
            }
        })*
    };
}
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64", target_feature = "simd128"))]
pub(crate) use operators;
