//! Accuracy against time: every setting that trades one for the other, measured on the same stream in one run.
//!
//! Accuracy has two senses here. The *computation* is accurate if it comes near to what the stream says: the Gaussians
//! of its finest level, made by the best heads in double precision and drawn by [`b2p::renderer::reference`], in double
//! precision and without any cut-off. The *truth* is the object itself: pictures of its mesh, or, if the mesh is not at
//! hand, of the cloud that was coded, as surfels. What coding has lost is missing in the truth alone.
//!
//! Against both stand, one knob at a time and in combination, the coarser levels, other heads, the precisions of the
//! network, the qualities of the renderer, and smaller pictures, enlarged as a viewer does. Instructions and threads
//! change time alone; that they hardly change the picture is shown by their rows.
//!
//! What decides the next bit of a stream is exact with every setting: none of the knobs bears on it.
//!
//! Settings take turns: each is run once in every repeat, so that whatever disturbs the machine disturbs all alike.
//! Medians are given with their quartiles, and where those of two settings overlap, the two cannot be told apart.

mod double;
mod effects;
mod hard_cases;
mod page;
mod plot;
mod report;
mod run;
mod scenes;
mod setting;
mod truth;

use b2p::cloud::ColouredVoxels;
use b2p::container::version;
use b2p::gaussians::learned::HeadsModel;
use b2p::latents::network::Model;
use b2p::limits::Limits;
use b2p::renderer::camera::Camera;
use b2p::{Decoder, Error, Result};
use serde::Serialize;

use crate::surface::Surface;

pub use effects::EffectCost;
pub use hard_cases::{BOUND, CaseError, HardCase};
pub use page::page;
pub use plot::plot;
pub use report::{Crop, Measured, Report, Row, STAGES};
pub use setting::{Choices, Decode, Knob, QUALITIES, Setting, pareto_front};
pub use truth::{of_cloud, of_mesh};

use run::Run;

/// What is decoded, and with what.
pub struct MeasuredInput<'a> {
    /// A stream.
    pub stream: &'a [u8],
    /// The model file: of a stream of version 2 that it was coded with, of others heads.
    pub model: &'a [u8],
    /// What was coded, if it is there: pictures are held against its own as well.
    pub origin: Option<Origin<'a>>,
    /// Limits of decoding and drawing.
    pub limits: &'a Limits,
}

/// What a stream was made of.
#[derive(Clone, Copy)]
pub enum Origin<'a> {
    /// A mesh, in the world's space.
    Mesh(&'a Surface),
    /// A cloud.
    Cloud(&'a ColouredVoxels),
}

/// What pictures are held against in the second sense.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum TruthKind {
    /// Pictures of the mesh.
    Mesh,
    /// Those of the cloud, as surfels.
    Cloud,
}

impl MeasuredInput<'_> {
    /// A decoder of the stream, with a freshly loaded model.
    ///
    /// # Errors
    /// Those of reading the model.
    pub fn decoder(&self) -> Result<Decoder> {
        let decoder = Decoder::new().with_limits(self.limits.clone());
        Ok(match self.is_learned() {
            true => decoder.with_model(Model::from_bytes(self.model)?),
            false => decoder.with_heads_model(HeadsModel::from_bytes(self.model)?),
        })
    }

    /// Whether the stream has version 2.
    pub fn is_learned(&self) -> bool {
        version(self.stream) == Some(2)
    }

    /// What the truth is.
    pub fn truth_kind(&self) -> Option<TruthKind> {
        self.origin.map(|origin| match origin {
            Origin::Mesh(_) => TruthKind::Mesh,
            Origin::Cloud(_) => TruthKind::Cloud,
        })
    }
}

/// How much is measured.
#[derive(Debug, Clone)]
pub struct Options {
    /// Width and height of the pictures.
    pub size: [u32; 2],
    /// Pictures, once around.
    pub views: u32,
    /// Times that everything is measured.
    pub repeats: u32,
}

impl Options {
    /// The cameras of all views: 20° up, 2.6 away, a field of view of 45°; their pictures `shrink` times smaller.
    fn cameras(&self, shrink: u32) -> Result<Vec<Camera>> {
        let [width, height] = self.size.map(|side| side.div_ceil(shrink));
        let view = |i: u32| {
            let azimuth = 20.0 + 360.0 * f64::from(i) / f64::from(self.views);
            Camera::orbit(azimuth, 20.0, 2.6, 45.0, width, height)
        };
        (0..self.views).map(view).collect()
    }
}

/// Measures all settings; `say` receives what is being done.
///
/// # Errors
/// Those of decoding and drawing; [`Error::Usage`] if the stream has no level with Gaussians, or nothing is to be
/// measured.
pub fn run(subject: &MeasuredInput<'_>, options: &Options, say: &dyn Fn(&str)) -> Result<Report> {
    if options.views == 0 || options.repeats == 0 {
        return Err(Error::Usage("no view or no repeat leaves nothing to measure".into()));
    }
    let choices = Run::choices(subject)?;
    let ladder = choices.ladder();
    if ladder.is_empty() {
        return Err(Error::Usage("the stream has no level with Gaussians".into()));
    }
    let combinations = choices.combinations();
    let mut settings: Vec<Setting> = ladder.iter().map(|(_, setting)| *setting).collect();
    settings.extend(&combinations);
    let mut run = Run::new(subject, options, &settings)?;
    let truth = run.truth(&choices, say)?;
    run.measure(&truth, say)?;
    let take = |(knob, setting): (Knob, Setting)| {
        let measured = run.measured(setting)?;
        Some(Row::new(knob, setting, measured, options))
    };
    let combinations = combinations.into_iter().map(|s| (Knob::Combination, s));
    let mut report = Report::new(
        subject,
        options,
        &truth,
        ladder.into_iter().filter_map(take).collect(),
        combinations.filter_map(take).collect(),
    )?;
    say("hard cases");
    report.renderer_cases = hard_cases::renderer_cases(subject)?;
    report.network_cases = hard_cases::network_cases(subject)?;
    say("effects");
    report.effects = effects::effect_costs(subject, options)?;
    Ok(report)
}
