//! Nothing recurses as deep as a stream says: threads with small stacks decode and draw everything.

use b2p::Limits;
use b2p::encoder::{Options, encode};
use b2p::gaussians::Gaussians;
use b2p::log::Log;
use b2p::renderer::camera::Camera;
use b2p::renderer::{Background, render};

use crate::common::{Ball, cloud_of};
use crate::{decoded, model};

/// A thirty-second of what Linux gives the main thread, an eighth of what Rust gives others; unoptimised code must do
/// with it too.
const STACK: usize = 256 << 10;

/// Runs it on a thread of so little stack, whose parallel work is done by threads of no more; overflowing it ends the
/// process.
fn on_small_stacks<T: Send>(run: impl FnOnce() -> T + Send) -> T {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).stack_size(STACK);
    let pool = pool.build().expect("threads start");
    pool.install(run)
}

#[test]
fn the_deepest_octree_and_the_widest_level_are_decoded_on_small_stacks() {
    let model = model();
    let far = |i: u64| i.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 1;
    let clouds = [
        cloud_of(21, (0..500).map(far).collect()),
        cloud_of(10, vec![12345]),
        Ball::new(7, 50.0).cloud(),
    ];
    for cloud in clouds {
        let encoded = encode(&cloud, &model, &Options::default(), &Log::default());
        let bytes = encoded.expect("the cloud can be coded").bytes;
        let of = |bytes: &[u8]| decoded(&model, bytes, None);
        let expected = of(&bytes);
        assert!(expected.is_ok());
        assert_eq!(on_small_stacks(|| of(&bytes)), expected);
        let cut = &bytes[..bytes.len() - 1];
        assert_eq!(on_small_stacks(|| of(cut)), of(cut));
    }
}

/// Half a million splats, one behind the other.
#[test]
fn deep_piles_of_splats_are_drawn_on_small_stacks() {
    let count = 500_000;
    let pile = Gaussians {
        position: (0..count).map(|i| [0.0, 0.0, i as f32 * 1e-7]).collect(),
        scale: vec![[0.001; 3]; count],
        rotation: vec![[1.0, 0.0, 0.0, 0.0]; count],
        opacity: vec![0.001; count],
        colour: vec![[0.5; 3]; count],
        ..Gaussians::default()
    };
    let camera = Camera::orbit(0.0, 0.0, 3.0, 45.0, 64, 64).expect("a camera");
    let draw = |limits: &Limits| render(&pile, &camera, Background::WHITE, limits).map(|(p, _)| p);
    let whole = draw(&Limits::default()).expect("a picture");
    let small = on_small_stacks(|| draw(&Limits::default())).expect("a picture");
    assert!(small == whole);
}
