//! `b2p render` of a scene: pictures of the blocks that each camera sees.

use b2p::gaussians::Gaussians;
use b2p::renderer::camera::Extent;
use b2p::renderer::{Effects, Renderer};
use b2p::scene::ViewOptions;
use b2p::{Limits, SceneDecoder, Wanted};

use super::super::args::{Format, Render};
use super::super::manners::{self, Said};
use super::super::picture::{Artist, format_of};
use super::super::progress::Progress;
use super::super::render::{Drawing, describe, numbers, permit, pictures};
use super::super::table::steps;
use super::super::views::shots;
use super::super::{Failure, Result, load};
use super::{Reader, complain};

/// Draws pictures of a scene. Of one file for many pictures all of it is decoded, else what each camera sees.
pub fn run(args: &Render, limits: &Limits, progress: &Progress) -> Result<Said> {
    if args.budget.is_given() {
        let what = "it is a scene, which is drawn without a budget: --level, --lod and --heads choose how";
        return Err(Failure(format!("{}: {what}", args.input.display())));
    }
    let scene = super::open(&args.input, limits)?;
    let decoder = SceneDecoder::new(load::decoder(&[], &args.detail, &args.model, limits)?);
    let fail = Failure::in_file(&args.input);
    let extent = extent(args, &scene, limits)?;
    let axes = scene.axes().unwrap_or_default();
    let cameras = shots(args, &scene.frame(), &extent, &axes, limits)?;
    permit(args, &cameras)?;
    let log = progress.log();
    let one_file = args.contact_sheet || args.turntable.is_some() || format_of(args, cameras.len())? == Format::Y4m;
    if one_file {
        super::reserve(&args.input, &scene, &decoder, &Wanted::All, limits)?;
        let blocks = scene.blocks().len();
        let decoded = log.step("decode scene", blocks, "blocks", || {
            decoder.gaussians(&scene, &Wanted::All)
        });
        let decoded = decoded.map_err(&fail)?;
        let drawing = Drawing {
            args,
            limits,
            detail: None,
            chosen: None,
        };
        let said = pictures(&drawing, &decoded.content, &axes, &log)?;
        complain(&args.input, &decoded.lost, decoded.blocks)?;
        return Ok(said);
    }
    let options = ViewOptions::default().with_voxel_pixels(args.lod);
    let (mut all, mut report) = (Vec::new(), String::new());
    let (mut lost, mut most) = (Vec::new(), 0);
    let mut renderer = None;
    for shot in &cameras {
        let needed = decoder.visible_memory(&scene, &shot.camera, options).map_err(&fail)?;
        if limits.check_bytes("", needed).is_err() {
            warn_of_memory(args, needed);
        }
        let name = format!("decode what is seen in {}", shot.path.display());
        let seen = log.step(name, scene.blocks().len(), "blocks", || {
            decoder.visible(&scene, &shot.camera, options)
        });
        let seen = seen.map_err(&fail)?;
        let gaussians: &Gaussians = &seen.content;
        let drawn = renderer.take().map_or_else(|| new_renderer(args), Ok)?;
        let mut artist = Artist::new(drawn, gaussians, limits, args, format_of(args, cameras.len())?);
        let name = format!("draw {}", shot.path.display());
        let stats = log.step(name, gaussians.len(), "Gaussians", || artist.draw(&shot.camera))?;
        let to = match manners::is_pipe(&args.output) {
            true => &*args.output,
            false => shot.path.as_path(),
        };
        manners::write(to, |w| artist.write(w, to))?;
        report += &describe(&shot.path, &stats);
        all.push(numbers(&shot.path, shot.camera.size(), &stats));
        renderer = Some(artist.renderer);
        most = most.max(seen.blocks);
        if lost.is_empty() {
            lost = seen.lost;
        }
    }
    complain(&args.input, &lost, most)?;
    if manners::json() || args.stats.is_some() {
        let result = format!("{:#}\n", serde_json::json!(all));
        return Ok(Said { result, report }.beside(&args.output));
    }
    let report = format!("{}\n{report}", steps(&log.steps()));
    let result = String::new();
    Ok(Said { report, result })
}

/// Says, before anything is decoded, that the limits may not suffice, and what does.
fn warn_of_memory(args: &Render, needed: u64) {
    let megabytes = needed.div_ceil(1 << 20);
    manners::warn(&format!(
        "{}: what the camera sees may take {megabytes} MiB, more than --max-memory, unless much of it is hidden; a greater \
         --lod, {} now, takes less",
        args.input.display(),
        args.lod
    ));
}

/// The part of the cube that the scene takes, by its coarsest level; the cube where cameras do not depend on it.
fn extent(args: &Render, scene: &Reader, limits: &Limits) -> Result<Extent> {
    if args.camera.is_some() || args.view.orbit.distance.is_some() {
        return Ok(Extent::cube());
    }
    let decoder = load::decoder(&[], &args.detail, &args.model, limits)?;
    let extent = SceneDecoder::new(decoder).extent(scene);
    extent.map_err(Failure::in_file(&args.input))
}

fn new_renderer(args: &Render) -> Result<Renderer> {
    let mut effects = Effects::default();
    for (effect, choice) in &args.effect {
        effects.set(*effect, *choice);
    }
    let mut renderer = Renderer::new().with_isa(load::isa(args.model.isa.as_deref())?);
    renderer.set_effects(effects);
    renderer.set_quality(args.quality);
    Ok(renderer)
}
