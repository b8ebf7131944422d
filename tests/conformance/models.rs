//! The models that the streams of the suite are coded with.

use b2p::latents::network::{Model, Shape, Upsample, untrained};

/// A model of the suite; `lite` is the one that ships.
pub fn model(name: &str) -> Model {
    let tiny = Shape::tiny();
    let made = |shape: Shape, seed| untrained(&shape, seed);
    let bytes = match name {
        "tiny" => made(tiny, 0),
        "other" => made(tiny, 1),
        "nearest" => made(
            Shape {
                upsample: Upsample::Nearest,
                ..tiny
            },
            2,
        ),
        "wide" => made(
            Shape {
                channels: 32,
                latents: 8,
                pem_blocks: 2,
                fr_blocks: 2,
                ..tiny
            },
            3,
        ),
        "plain" => made(
            Shape {
                inception_relu: false,
                resblock_relu: false,
                latent_shift: 3,
                ..tiny
            },
            4,
        ),
        "base" => made(
            Shape {
                latent_roles: 1,
                near_channels: [0, 0],
                ..tiny
            },
            5,
        ),
        "bare" => made(
            Shape {
                latent_roles: 2,
                fr_roles: 2,
                near_channels: [8, 0],
                ..tiny
            },
            6,
        ),
        "learning" => made(Shape { learning: true, ..tiny }, 7),
        "lite" => {
            let path = crate::root().join("models/lite.safetensors");
            std::fs::read(path).expect("the model that ships")
        }
        _ => panic!("the suite has no model {name}"),
    };
    Model::from_bytes(&bytes).expect("a model of the suite loads")
}
