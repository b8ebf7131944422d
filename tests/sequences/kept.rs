//! Groups that are kept for a run that goes on.

use std::collections::HashMap;
use std::ops::Range;
use std::sync::{Arc, Mutex};

use b2p::encoder::transform::QualityTarget;
use b2p::{Error, KeptGroups};

use super::{encoded, encoder, moving};

/// Groups that are kept in memory.
#[derive(Debug, Default)]
struct InMemory(Mutex<HashMap<String, Vec<u8>>>);

impl KeptGroups for InMemory {
    fn find(&self, frames: Range<u64>, settings: &str) -> Option<Vec<u8>> {
        self.0.lock().unwrap().get(&format!("{frames:?} {settings}")).cloned()
    }

    fn keep(&self, frames: Range<u64>, settings: &str, sequence: &[u8]) {
        let name = format!("{frames:?} {settings}");
        self.0.lock().unwrap().insert(name, sequence.to_vec());
    }
}

#[test]
fn a_run_after_one_that_failed_codes_only_the_groups_that_are_not_kept() {
    let kept = Arc::new(InMemory::default());
    let encoder = encoder().with_kept_groups(Arc::<InMemory>::clone(&kept));
    let fails = |frame| match frame {
        4 => Err(Error::Usage("a cloud that cannot be read".into())),
        _ => Ok(moving(frame)),
    };
    assert!(encoder.encode(7, fails, |_| {}).is_err());
    let coded = Mutex::new(Vec::new());
    let second = encoder.encode(
        7,
        |frame| {
            coded.lock().unwrap().push(frame);
            Ok(moving(frame))
        },
        |_| {},
    );
    let mut coded = coded.into_inner().unwrap();
    coded.sort();
    assert_eq!(coded, [3, 4, 5]);
    assert!(second.unwrap() == encoded(7));
    // Other settings need other groups.
    let finer = encoder.with_quality(QualityTarget::Step(5.0));
    let bytes = finer.encode(7, |frame| Ok(moving(frame)), |_| {});
    assert!(bytes.unwrap().len() > encoded(7).len());
    assert_eq!(kept.0.lock().unwrap().len(), 6);
}
