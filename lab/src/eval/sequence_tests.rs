use super::super::protocol::SIDE;
use super::*;
use crate::cli::Cli;
use clap::Parser;

/// Runs the program's `animate` on a motion made by code: three frames of few points.
fn animate(motion: &str, folder: &Path, seed: &str) {
    let output = folder.to_str().unwrap();
    let fixed = ["--frames", "3", "--points", "20000", "--bits", "6", "--noise", "0.3"];
    let own = [
        "b2p-lab",
        "animate",
        "--procedural",
        motion,
        "-o",
        output,
        "--seed",
        seed,
    ];
    Cli::try_parse_from(own.into_iter().chain(fixed))
        .unwrap()
        .run()
        .unwrap();
}

fn read(folder: &Path) -> Vec<Vec<u8>> {
    let names = ["frame_0000.ply", "frame_0001.ply", "frame_0002.ply", "sequence.json"];
    names.map(|name| std::fs::read(folder.join(name)).unwrap()).to_vec()
}

#[test]
fn the_same_seed_gives_the_same_files_and_each_frame_other_points() {
    let folders = [(); 3].map(|()| tempfile::tempdir().unwrap());
    for (folder, seed) in folders.iter().zip(["4", "4", "5"]) {
        animate("breathing", folder.path(), seed);
    }
    let [a, b, c] = folders.each_ref().map(|f| read(f.path()));
    assert_eq!(a, b);
    assert_ne!(a[0], c[0]);
    assert_ne!(a[0], a[1]);
}

#[test]
fn a_still_sequence_has_no_temporal_error_where_its_frames_are_equal_and_some_where_they_are_not() {
    let (clouds, copies) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    animate("still", clouds.path(), "1");
    for i in 0..3 {
        let copy = copies.path().join(format!("{i}.ply"));
        std::fs::copy(clouds.path().join("frame_0000.ply"), copy).unwrap();
    }
    let truth = Sequence::read(clouds.path()).unwrap();
    let motion = truth.source.open().unwrap();
    let camera = Camera::orbit(0.0, 20.0, 3.0, 45.0, 2 * SIDE, 2 * SIDE).unwrap();
    let patterns = [copies.path().join("%d.ply"), clouds.path().join("frame_%04d.ply")];
    let open = |path: &PathBuf| {
        let item: Item = path.to_str().unwrap().parse().unwrap();
        Coded::open(&item, 3, HeadSet::Surfels, None).unwrap()
    };
    let items = patterns.iter().map(open).collect();
    let rows = judge(&truth, &motion, 3, &camera, items).unwrap();
    assert_eq!((rows[0].temporal_mse, rows[0].temporal_psnr), (0.0, f64::INFINITY));
    assert!(rows[1].temporal_mse > 0.0);
    for row in rows {
        assert!(row.inside_psnr > 12.0 && row.psnr > 12.0, "{row:?}");
        assert!(row.worst_ssimulacra2 <= row.ssimulacra2);
    }
}

#[test]
fn the_temporal_error_is_that_of_differences() {
    // Both pictures are off by the same 5: their difference is not.
    let mut pool = Pool::default();
    pool.add([15, 0, 0], [10, 0, 0]);
    assert!((pool.mse() - 25.0 / 3.0).abs() < 1e-12);
    assert_eq!(Pool { sum: 0, count: 3 }.psnr(), f64::INFINITY);
}

#[test]
fn the_inside_keeps_away_from_the_silhouette_and_the_border() {
    let mask: Vec<bool> = (0..49).map(|i| i != 0).collect();
    let inside = eroded(&mask, 7, 2);
    let kept: Vec<usize> = (0..49).filter(|&i| inside[i]).collect();
    assert_eq!(kept, [17, 18, 23, 24, 25, 30, 31, 32]);
}

#[test]
fn patterns_name_files_and_missing_frames_are_counted() {
    let folder = tempfile::tempdir().unwrap();
    for i in 0..2 {
        std::fs::write(folder.path().join(format!("f_{i:03}.b2p")), "").unwrap();
    }
    let pattern = folder.path().join("f_%03d.b2p");
    let found = files(&pattern, 5).unwrap();
    assert_eq!(found, files(folder.path(), 5).unwrap());
    assert_eq!(found.len(), 2);
    let item: Item = pattern.to_str().unwrap().parse().unwrap();
    let error = Coded::open(&item, 3, HeadSet::Surfels, None).unwrap_err().to_string();
    assert!(error.contains("2 files for 3 frames"), "{error}");
    assert!(files(&folder.path().join("f_%03x.b2p"), 1).is_err());
    assert!(files(Path::new("f_%999d.b2p"), 1).is_err());
}
