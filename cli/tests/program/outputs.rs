//! Outputs that are no regular files.

use std::os::unix::fs::{FileTypeExt, symlink};

use super::{folder_with_stream, succeeds};

#[test]
fn an_output_that_is_a_fifo_or_a_link_stays_what_it_is() {
    let folder = folder_with_stream();
    let at = folder.path();
    let decode = |to: &str| succeeds(at, &["decode", "ball.b2p", "-o", to]);
    decode("file.ply");
    let expected = std::fs::read(at.join("file.ply")).unwrap();
    symlink("behind.ply", at.join("link.ply")).unwrap();
    decode("link.ply");
    assert!(at.join("link.ply").is_symlink());
    assert_eq!(std::fs::read(at.join("behind.ply")).unwrap(), expected);

    let fifo = at.join("fifo.ply");
    let made = std::process::Command::new("mkfifo").arg(&fifo).status();
    if made.is_ok_and(|status| status.success()) {
        let reader = std::thread::spawn({
            let fifo = fifo.clone();
            move || std::fs::read(fifo).unwrap()
        });
        decode("fifo.ply");
        assert_eq!(reader.join().unwrap(), expected);
        assert!(std::fs::symlink_metadata(&fifo).unwrap().file_type().is_fifo());
    }
}
