use std::process::Command;

use super::*;

fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    write_file(path, |w| {
        w.write_all(bytes).map_err(|source| Error::Io {
            path: path.to_owned(),
            source,
        })
    })
}

/// Makes a special file with a program of that name; false, with a word, where that is not permitted.
fn make(program: &str, path: &Path, kind: &[&str]) -> bool {
    let made = Command::new(program).arg(path).args(kind).output();
    let made = made.is_ok_and(|output| output.status.success());
    if !made {
        eprintln!("skipped: {program} is not permitted here");
    }
    made
}

fn entries(folder: &Path) -> usize {
    std::fs::read_dir(folder).unwrap().count()
}

#[test]
fn a_failed_write_leaves_the_old_file_and_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("out.txt");
    std::fs::write(&path, b"old").unwrap();
    let failed = write_file(&path, |w| {
        w.write_all(b"half").unwrap();
        Err(Error::Usage("stop".into()))
    });
    assert!(failed.is_err());
    assert_eq!(std::fs::read(&path).unwrap(), b"old");
    assert_eq!(entries(folder.path()), 1);
}

#[test]
fn a_file_is_replaced_by_another_whose_temporary_name_is_gone_and_no_longer_listed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("out.txt");
    for bytes in [b"first".as_slice(), b"2nd"] {
        write(&path, bytes).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), bytes);
        assert_eq!(entries(folder.path()), 1);
    }
    assert!(!lock().iter().any(|p| p.starts_with(folder.path())));
}

#[test]
fn two_temporary_files_beside_one_destination_have_different_names() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("out.txt");
    write_file(&path, |w| {
        w.write_all(b"outer").unwrap();
        write(&path, b"inner")?;
        assert_eq!(entries(folder.path()), 2);
        Ok(())
    })
    .unwrap();
    assert_eq!(std::fs::read(&path).unwrap(), b"outer");
    assert_eq!(entries(folder.path()), 1);
}

#[test]
fn a_missing_folder_is_named_in_the_error() {
    let error = write(Path::new("/no/such/folder/x"), b"").unwrap_err();
    assert!(error.to_string().contains("/no/such/folder/x"));
}

#[test]
fn a_folder_is_no_output_and_stays() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("sub");
    std::fs::create_dir(&path).unwrap();
    let error = write(&path, b"x").unwrap_err();
    assert!(error.to_string().contains("sub"), "{error}");
    assert!(path.is_dir());
    assert_eq!(entries(folder.path()), 1);
}

#[test]
fn a_name_as_long_as_file_systems_allow_can_be_written() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("n".repeat(255));
    write(&path, b"long").unwrap();
    assert_eq!(std::fs::read(&path).unwrap(), b"long");
}

#[test]
fn what_would_be_replaced_is_a_regular_file_that_is_there() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("out");
    assert_eq!(replaced(&path), None);
    std::fs::write(&path, b"old").unwrap();
    assert_eq!(replaced(&path), Some(path));
    assert_eq!(replaced(folder.path()), None);
    assert_eq!(replaced(Path::new("/dev/null")), None);
}

#[cfg(unix)]
mod special {
    use std::os::unix::fs::{FileTypeExt, PermissionsExt, symlink};

    use super::*;

    #[test]
    fn a_device_takes_the_bytes_and_stays_a_device() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("null");
        if !make("mknod", &path, &["c", "1", "3"]) {
            return;
        }
        let device = || std::fs::symlink_metadata(&path).unwrap().file_type();
        // Container file systems may permit the node and not its use: it has to stay in both cases.
        if let Err(error) = write(&path, b"gone") {
            eprintln!("not written: {error}");
        }
        assert!(device().is_char_device());
        assert_eq!(entries(folder.path()), 1);
        let link = folder.path().join("link");
        symlink("null", &link).unwrap();
        let _ = write(&link, b"gone");
        assert!(device().is_char_device());
        assert!(link.is_symlink());
    }

    #[test]
    fn a_full_device_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("full");
        if make("mknod", &path, &["c", "1", "7"]) {
            assert!(write(&path, b"x").is_err());
            assert!(path.exists());
        }
    }

    #[test]
    fn the_reader_of_a_fifo_gets_the_bytes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("fifo");
        if !make("mkfifo", &path, &[]) {
            return;
        }
        let reader = std::thread::spawn({
            let path = path.clone();
            move || std::fs::read(path).unwrap()
        });
        write(&path, b"through").unwrap();
        assert_eq!(reader.join().unwrap(), b"through");
        let file_type = std::fs::symlink_metadata(&path).unwrap().file_type();
        assert!(file_type.is_fifo());
        assert_eq!(entries(folder.path()), 1);
    }

    #[test]
    fn links_stay_and_the_file_that_they_lead_to_is_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::create_dir(at("sub")).unwrap();
        std::fs::write(at("sub/file"), b"old").unwrap();
        symlink("sub/middle", at("relative")).unwrap();
        symlink("../sub/file", at("sub/middle")).unwrap();
        symlink(at("sub/file"), at("absolute")).unwrap();
        for link in ["relative", "absolute"] {
            write(&at(link), link.as_bytes()).unwrap();
            assert!(at(link).is_symlink());
            assert_eq!(std::fs::read(at("sub/file")).unwrap(), link.as_bytes());
            assert!(!at("sub/file").is_symlink());
        }
        assert_eq!(replaced(&at("relative")), Some(at("sub/../sub/file")));
        let failed = write_file(&at("absolute"), |_| Err(Error::Usage("stop".into())));
        assert!(failed.is_err());
        assert_eq!(std::fs::read(at("sub/file")).unwrap(), b"absolute");
        assert_eq!(entries(&at("sub")), 2);
    }

    #[test]
    fn the_file_that_a_dangling_link_leads_to_is_made() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        symlink("new", at("link")).unwrap();
        write(&at("link"), b"made").unwrap();
        assert!(at("link").is_symlink());
        assert_eq!(std::fs::read(at("new")).unwrap(), b"made");
        symlink("none/new", at("lost")).unwrap();
        assert!(write(&at("lost"), b"made").is_err());
        assert!(at("lost").is_symlink());
    }

    #[test]
    fn links_in_a_circle_are_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        symlink("b", at("a")).unwrap();
        symlink("a", at("b")).unwrap();
        assert!(write(&at("a"), b"x").is_err());
        assert!(at("a").is_symlink() && at("b").is_symlink());
    }

    #[test]
    fn a_replaced_file_keeps_its_permissions() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out");
        std::fs::write(&path, b"old").unwrap();
        let mode = || std::fs::metadata(&path).unwrap().permissions().mode() & 0o777;
        std::fs::set_permissions(&path, PermissionsExt::from_mode(0o640)).unwrap();
        write(&path, b"new").unwrap();
        assert_eq!(mode(), 0o640);
    }

    #[test]
    fn an_open_file_is_written_through_the_link_of_its_descriptor() {
        use std::os::fd::AsRawFd;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out");
        let file = File::create(&path).unwrap();
        let link = PathBuf::from(format!("/proc/self/fd/{}", file.as_raw_fd()));
        if !link.exists() {
            return;
        }
        assert_eq!(replaced(&link), None);
        write(&link, b"through").unwrap();
        assert_eq!(file.metadata().unwrap().len(), 7);
        assert_eq!(std::fs::read(&path).unwrap(), b"through");
        assert_eq!(entries(folder.path()), 1);
    }
}
