//! The machine that measurements were made on, as far as it tells.

use b2p_kernels::Isa;
use serde::{Deserialize, Serialize};

/// What figures depend on beside the program's arguments.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Machine {
    /// The processor's name for itself, or its architecture where it has none.
    pub processor: String,
    /// Logical processors that this process may use.
    pub cores: usize,
    /// The best instruction set that the kernels support on it.
    pub isa: String,
    /// The program's version.
    pub version: String,
}

impl Machine {
    /// This one.
    pub fn this() -> Machine {
        let named = std::fs::read_to_string("/proc/cpuinfo").ok();
        let named = named.as_deref().and_then(|text| {
            let line = text.lines().find(|line| line.starts_with("model name"))?;
            Some(line.split_once(':')?.1.trim().to_owned())
        });
        Machine {
            processor: named.unwrap_or_else(|| std::env::consts::ARCH.to_owned()),
            cores: std::thread::available_parallelism().map_or(1, |n| n.get()),
            isa: Isa::detect().to_string(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
        }
    }
}
