//! The file beside an output, which says what its format has no place for.

use std::path::Path;

use b2p::{Error, output};
use b2p_formats::sidecar::Sidecar;

use super::{Result, manners};

/// Whether a file can lie beside this output.
fn is_possible(to: &Path) -> bool {
    let is_other = std::fs::metadata(to).is_ok_and(|data| !data.is_file());
    !manners::is_pipe(to) && !is_other
}

/// Fails, before `to` is written, if the file beside it would replace one of another program without permission. Those
/// of this program are part of what they lie beside.
pub fn check(to: &Path, sidecar: Option<&Sidecar>) -> Result<()> {
    if sidecar.is_none() || !is_possible(to) || Sidecar::beside(to).is_some() {
        return Ok(());
    }
    manners::permit(&[&Sidecar::path_of(to)], &[])
}

/// Writes what belongs beside `to`, which has been written, and says so. What lies there for an earlier file is
/// replaced or removed.
pub fn settle(to: &Path, sidecar: Option<&Sidecar>) -> Result<()> {
    let beside = Sidecar::path_of(to);
    let name = to.display();
    let Some(sidecar) = sidecar else {
        if is_possible(to) && Sidecar::beside(to).is_some() {
            let io = |source| Error::Io {
                path: beside.clone(),
                source,
            };
            std::fs::remove_file(&beside).map_err(io)?;
            manners::warn(&format!(
                "removed {}: it was about the earlier {name}",
                beside.display()
            ));
        }
        return Ok(());
    };
    if sidecar.offset != [0.0; 3] {
        let [x, y, z] = sidecar.offset;
        manners::warn(&format!("{name}: coordinates are less an offset of {x} {y} {z}"));
    }
    let contents = sidecar.contents();
    if !is_possible(to) {
        manners::warn(&format!("{name}: what the format has no place for is lost: {contents}"));
        return Ok(());
    }
    output::write_file(&beside, |w| {
        let io = |source| Error::Io {
            path: beside.clone(),
            source,
        };
        w.write_all(sidecar.to_json(to).as_bytes()).map_err(io)
    })?;
    manners::warn(&format!("{} states {contents}", beside.display()));
    Ok(())
}
