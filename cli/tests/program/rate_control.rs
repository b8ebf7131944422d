//! `b2p encode --bits-per-point`, of learned streams.

use super::*;

#[test]
fn a_stream_of_at_most_so_many_bits_is_made_and_said_to_be() {
    let folder = folder_with_cloud();
    let at = folder.path();
    let points = Ball::new(7, 40.0).voxels().len() as f64;
    let learned = ["encode", "ball.ply", "--colours", "learned"];
    let encode = [&learned[..], &["-o", "ball.b2p", "--bits-per-point"]].concat();
    let said = succeeds(at, &[&encode[..], &["1.2"]].concat());
    let bits = |name: &str| std::fs::metadata(at.join(name)).unwrap().len() as f64 * 8.0 / points;
    assert!((1.0..=1.2).contains(&bits("ball.b2p")), "{said}");
    let words = format!("{:.4} bits per point of at most 1.2: λ scale 1.00, ", bits("ball.b2p"));
    assert!(said.contains(&words), "{said}");
    let step = said.trim().rsplit("residual in steps of ").next().unwrap();
    succeeds(at, &[&learned[..], &["-o", "by-hand.b2p", "--residual", step]].concat());
    let [found, by_hand] = ["ball.b2p", "by-hand.b2p"].map(|name| std::fs::read(at.join(name)).unwrap());
    assert!(found == by_hand, "what is said makes the same stream");
    succeeds(at, &["decode", "ball.b2p", "-o", "ball-g.ply"]);

    let said = succeeds(at, &[&encode[..], &["1000"]].concat());
    assert!(
        said.contains("of at most 1000: λ scale 1.00, residual in steps of 1, the finest"),
        "{said}"
    );
    assert!(
        said.contains(&format!("{:.4} bits per point", bits("ball.b2p"))),
        "{said}"
    );
}

#[test]
fn fewer_bits_than_there_can_be_write_nothing_and_say_what_can_be_done() {
    let folder = folder_with_cloud();
    for colours in ["transform", "learned"] {
        let encode = ["encode", "ball.ply", "-o", "x.b2p", "--bits-per-point"];
        fails(
            folder.path(),
            &[&encode[..], &["0.001", "--colours", colours]].concat(),
            &["ball.ply", "0.001 bits", "smallest stream", "--levels"],
        );
    }
}

#[test]
fn what_the_number_of_bits_decides_cannot_be_asked_for_as_well() {
    let folder = folder_with_cloud();
    let at = folder.path();
    let refused = |more: &[&str], words: &str| {
        let encode = ["encode", "ball.ply", "-o", "x.b2p", "--bits-per-point"];
        let output = b2p(at, &[&encode[..], more].concat());
        let errors = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{errors}");
        assert!(errors.contains(words), "{errors}");
        assert!(!at.join("x.b2p").exists());
    };
    refused(&["1", "--lambda-scale", "1"], "--lambda-scale");
    // The option's older name.
    refused(&["1", "--bit-price", "1"], "--lambda-scale");
    refused(&["1", "--residual", "coarse"], "--residual");
    for wrong in ["0", "nan", "inf", "some"] {
        refused(&[wrong], "0");
    }
}
