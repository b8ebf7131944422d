//! What a picture shows of the object, and several views in one file.

use super::*;

/// The distances of a picture's four borders from what is drawn, in pixels.
fn borders(picture: &tiny_skia::Pixmap) -> [u32; 4] {
    let (width, height) = (picture.width(), picture.height());
    let drawn = |x: u32, y: u32| picture.pixel(x, y).is_some_and(|p| p.alpha() > 40);
    let column = |x: u32| (0..height).any(|y| drawn(x, y));
    let row = |y: u32| (0..width).any(|x| drawn(x, y));
    let first = |n: u32, any: &dyn Fn(u32) -> bool| (0..n).position(any_at(any)).map_or(n, |i| i as u32);
    fn any_at(any: &dyn Fn(u32) -> bool) -> impl FnMut(u32) -> bool + '_ {
        move |i| any(i)
    }
    [
        first(width, &column),
        first(width, &|i| column(width - 1 - i)),
        first(height, &row),
        first(height, &|i| row(height - 1 - i)),
    ]
}

#[test]
fn the_whole_object_is_in_the_picture_whatever_its_shape_and_the_direction() {
    let folder = folder_with_stream();
    let at = folder.path();
    for size in ["200x200", "300x100", "100x300"] {
        for direction in [&[][..], &["--orbit", "40,70"], &["--orthographic"], &["--fov", "90"]] {
            let draw = [
                "render",
                "ball.b2p",
                "f.png",
                "--background",
                "transparent",
                "--size",
                size,
            ];
            succeeds(at, &[&draw[..], direction].concat());
            let borders = borders(&png(&at.join("f.png")));
            assert!(borders.iter().all(|b| *b >= 1), "{size} {direction:?}: {borders:?}");
            let least = borders.iter().min().unwrap();
            assert!(*least <= 12, "{size} {direction:?}: the object is small: {borders:?}");
        }
    }
    let near = [
        "render",
        "ball.b2p",
        "f.png",
        "--background",
        "transparent",
        "--orbit",
        "0,0,0.9",
    ];
    succeeds(at, &[&near[..], &["--size", "200x200"]].concat());
    assert_eq!(
        borders(&png(&at.join("f.png"))),
        [0; 4],
        "a distance that is given is kept"
    );
}

#[test]
fn a_point_to_look_at_is_in_the_middle() {
    let folder = folder_with_stream();
    let at = folder.path();
    // The ball's middle is at 64; its side is to the right in the world, so the ball moves to the left.
    let draw = |name: &str, point: &str| {
        let look = [
            "--look-at",
            point,
            "--orbit",
            "0,0,3",
            "--size",
            "120x120",
            "--background",
            "transparent",
        ];
        succeeds(at, &[&["render", "ball.b2p", name], &look[..]].concat());
        borders(&png(&at.join(name)))
    };
    let [left, right, ..] = draw("a.png", "64,64,64");
    assert!(left.abs_diff(right) <= 3, "{left} {right}");
    let [left, right, ..] = draw("b.png", "90,64,64");
    assert!(left + 10 < right, "{left} {right}");
}

#[test]
fn a_contact_sheet_shows_all_views_in_one_picture() {
    let folder = folder_with_stream();
    let at = folder.path();
    let sheet = ["render", "ball.b2p", "sheet.png", "--contact-sheet", "--size", "60x40"];
    let said = succeeds(at, &sheet);
    assert!(said.contains("sheet.png: 8 views"), "{said}");
    let picture = png(&at.join("sheet.png"));
    // Three columns; below each picture there is its label.
    assert_eq!(
        (picture.width(), picture.height()),
        (3 * 60 + 4 * 8, 3 * (40 + 16) + 4 * 8)
    );
    succeeds(at, &[&sheet[..], &["--views", "1"]].concat());
    assert_eq!(png(&at.join("sheet.png")).width(), 60 + 16);
    fails(
        at,
        &[&sheet[..], &["--max-pixels", "10000"]].concat(),
        &["contact sheet", "--max-pixels"],
    );
}

#[test]
fn a_turntable_is_one_file_of_many_frames() {
    let folder = folder_with_stream();
    let at = folder.path();
    let turn = |name: &str| {
        [
            "render",
            "ball.b2p",
            "--turntable",
            name,
            "--views",
            "4",
            "--size",
            "24x16",
        ]
        .map(String::from)
    };
    let run = |name: &str| {
        let arguments = turn(name);
        let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
        succeeds(at, &arguments)
    };
    for (name, magic) in [
        ("t.gif", &b"GIF89a"[..]),
        ("t.png", b"\x89PNG"),
        ("t.webp", b"RIFF"),
        ("t.y4m", b"YUV4"),
    ] {
        let said = run(name);
        assert!(said.contains(&format!("{name}: 4 views")), "{said}");
        assert!(std::fs::read(at.join(name)).unwrap().starts_with(magic), "{name}");
    }
    let video = turn("t.mp4");
    let video: Vec<&str> = video.iter().map(String::as_str).collect();
    match Command::new("ffmpeg").arg("-version").output() {
        Ok(_) => {
            succeeds(at, &video);
            let file = std::fs::read(at.join("t.mp4")).unwrap();
            assert_eq!(&file[4..8], b"ftyp");
        }
        Err(_) => {
            eprintln!("FFmpeg is not installed: only its absence is tested");
            fails(at, &video, &["t.mp4", "FFmpeg", ".gif"]);
        }
    }
    fails(at, &["render", "ball.b2p", "--turntable", "t.jpg"], &["t.jpg", ".webp"]);
    let leftovers = names_in(at)
        .into_iter()
        .filter(|name| name.to_string_lossy().contains(".b2p-"));
    assert_eq!(leftovers.count(), 0);
}
