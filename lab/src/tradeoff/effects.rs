//! What each effect costs where it is called for, and where it is not.

use std::time::Instant;

use serde::Serialize;

use super::scenes::{dense_surface, interleaved, iridescent};
use super::{MeasuredInput, Options};
use b2p::Result;
use b2p::gaussians::Gaussians;
use b2p::metrics::pixels_apart;
use b2p::metrics::{Spread, Verdict};
use b2p::renderer::camera::Camera;
use b2p::renderer::reference::{self, Cutoffs};
use b2p::renderer::{Background, Effect, EffectMode, EffectSet, Effects, Image, Renderer};

/// Splats of the scenes made for it.
const COUNT: usize = 60_000;
/// Side of the pictures that are compared with double precision.
const JUDGED: u32 = 96;

/// An effect on a scene.
#[derive(Debug, Clone, Serialize)]
pub struct EffectCost {
    /// Its name.
    pub effect: String,
    /// What is drawn.
    pub scene: String,
    /// Whether the scene calls for it: whether it is on when nothing is said.
    pub called_for: bool,
    /// Milliseconds of a picture with it forced off.
    pub off: Spread,
    /// With it forced on; harmonics that there are none of stay off.
    pub on: Spread,
    /// Whether on is faster or slower than off.
    pub verdict: Verdict,
    /// The worst pixel, in steps of eight bits, of the picture with it on, against double precision with the same
    /// effect.
    pub worst: f64,
}

struct Case {
    effect: Effect,
    name: &'static str,
    scene: &'static str,
    gaussians: Gaussians,
    camera: Camera,
    others: Effects,
}

fn cases(subject: &MeasuredInput<'_>, options: &Options) -> Result<Vec<Case>> {
    let stream = subject.decoder()?.decode(subject.stream)?;
    let side = options.size[0].min(options.size[1]);
    let stream_camera = || Camera::orbit(20.0, 20.0, 2.6, 45.0, side, side);
    let (plain, camera) = dense_surface(COUNT, 2.0, side)?;
    let (_, far) = dense_surface(COUNT, 0.4, side)?;
    let compensated = Gaussians {
        compensated: true,
        ..plain.clone()
    };
    let unsampled = Effects::default().with(Effect::Supersample, EffectMode::Off);
    // The near plane touches the surface.
    let inside = Camera::orbit(0.0, 0.0, 0.8 + Camera::NEAR, 90.0, side, side)?;
    let case = |effect, name, scene, gaussians: &Gaussians, camera, others| Case {
        effect,
        name,
        scene,
        gaussians: gaussians.clone(),
        camera,
        others,
    };
    let auto = Effects::default();
    let shiny = iridescent(plain.clone());
    let mingled = interleaved(4000);
    Ok(vec![
        case(
            Effect::Harmonics,
            "harmonics",
            "view-dependent colour of degree 3",
            &shiny,
            camera,
            auto,
        ),
        case(Effect::Harmonics, "harmonics", "plain colour", &plain, camera, auto),
        case(
            Effect::Antialias,
            "antialias",
            "made for it",
            &compensated,
            camera,
            unsampled,
        ),
        case(
            Effect::Antialias,
            "antialias",
            "the stream",
            &stream,
            stream_camera()?,
            unsampled,
        ),
        case(
            Effect::Supersample,
            "supersample",
            "made for it, 0.4 px wide",
            &compensated,
            far,
            auto,
        ),
        case(
            Effect::Supersample,
            "supersample",
            "made for it, 2 px wide",
            &compensated,
            camera,
            auto,
        ),
        case(Effect::Near, "near", "from within the surface", &plain, inside, auto),
        case(Effect::Near, "near", "the stream", &stream, stream_camera()?, auto),
        case(
            Effect::Order,
            "order",
            "discs that stand in each other",
            &mingled,
            camera,
            auto,
        ),
        case(Effect::Order, "order", "the stream", &stream, stream_camera()?, auto),
    ])
}

/// Every effect on a scene that calls for it and on one that doesn't, on and off in turns.
///
/// # Errors
/// Those of [`Decoder::decode`](b2p::Decoder::decode) and
/// [`Renderer::render`](b2p::renderer::Renderer::render).
pub fn effect_costs(subject: &MeasuredInput<'_>, options: &Options) -> Result<Vec<EffectCost>> {
    let cases = cases(subject, options)?;
    let mut times = vec![[Vec::new(), Vec::new()]; cases.len()];
    let mut called_for = vec![false; cases.len()];
    for repeat in 0..options.repeats {
        for (i, case) in cases.iter().enumerate() {
            if repeat == 0 {
                called_for[i] = case.is_on(case.draw(subject, EffectMode::Auto, &case.camera)?.2);
            }
            for (choice, times) in [EffectMode::Off, EffectMode::On].into_iter().zip(&mut times[i]) {
                times.push(case.draw(subject, choice, &case.camera)?.0);
            }
        }
    }
    let cost = |((case, [off, on]), called_for): ((&Case, [Vec<f64>; 2]), bool)| {
        let [off, on] = [off, on].map(Spread::of);
        Ok(EffectCost {
            effect: case.name.into(),
            scene: case.scene.into(),
            called_for,
            verdict: on.against(&off),
            off,
            on,
            worst: case.worst(subject)?,
        })
    };
    cases.iter().zip(times).zip(called_for).map(cost).collect()
}

impl Case {
    /// Milliseconds of a picture after one that is not counted, the picture, and what it was drawn with.
    fn draw(
        &self,
        subject: &MeasuredInput<'_>,
        choice: EffectMode,
        camera: &Camera,
    ) -> Result<(f64, Image, EffectSet)> {
        let mut effects = self.others;
        effects.set(self.effect, choice);
        let renderer = Renderer::new().with_effects(effects);
        let mut renderer = renderer.with_limits(subject.limits.clone());
        let mut image = Image::default();
        let mut draw = || renderer.render_into(&self.gaussians, camera, &mut image);
        draw()?;
        let start = Instant::now();
        let stats = draw()?;
        let took = start.elapsed().as_secs_f64() * 1e3;
        Ok((took, image, stats.effects))
    }

    fn is_on(&self, set: EffectSet) -> bool {
        set.is_on(self.effect)
    }

    /// The worst pixel of a small picture with the effect on.
    fn worst(&self, subject: &MeasuredInput<'_>) -> Result<f64> {
        let mut camera = self.camera;
        let shrink = f64::from(JUDGED) / f64::from(camera.width);
        for length in [&mut camera.fx, &mut camera.fy, &mut camera.cx, &mut camera.cy] {
            *length *= shrink;
        }
        (camera.width, camera.height) = (JUDGED, JUDGED);
        let (_, image, set) = self.draw(subject, EffectMode::On, &camera)?;
        let cutoffs = Cutoffs {
            compensated: set.antialias,
            ray_space: true,
            ordered: set.order,
            ..Cutoffs::NONE
        };
        let mut gaussians = self.gaussians.clone();
        if set.harmonics {
            colours_seen(&mut gaussians, &camera);
        }
        let fine = camera.magnified(set.supersample);
        let mut truth = reference::render(&gaussians, &fine, Background::WHITE, cutoffs);
        while truth.width > JUDGED {
            truth = truth.box_half();
        }
        Ok(pixels_apart(&truth, &image).1)
    }
}

/// Turns view-dependent colour into the colour of this view.
fn colours_seen(gaussians: &mut Gaussians, camera: &Camera) {
    let eye = camera.pose.inverse().translation;
    for i in 0..gaussians.len() {
        let centre = glam::DVec3::from(gaussians.position[i].map(f64::from));
        let towards = (centre - eye).normalize_or_zero().as_vec3().into();
        gaussians.colour[i] = gaussians.harmonics.seen(i, gaussians.colour[i], towards);
    }
}
