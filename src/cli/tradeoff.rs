//! `b2p tradeoff`: what accuracy costs in time on this machine.

use b2p::cloud::{ColouredVoxels, PointCloud, voxelise_closed};
use b2p::encoder;
use b2p::log::Log;
use b2p::network::Model;
use b2p::tradeoff::{self, Options, Report, Row, Spread, Subject, Verdict};
use b2p::{Error, Limits, embedded, output};

use super::args::Tradeoff;
use super::progress::Progress;
use super::table::table;
use super::{Failure, Result, load};

/// Measures, prints a table, and writes it with all else into a folder.
pub fn run(args: &Tradeoff, limits: &Limits, progress: &Progress) -> Result<String> {
    let stream = match &args.input {
        Some(path) => load::bytes(path)?,
        None => embedded::SAMPLE.to_vec(),
    };
    let file = match &args.model {
        Some(path) => load::bytes(path)?,
        None => embedded::MODEL.to_vec(),
    };
    let in_input = |error| match &args.input {
        Some(path) => Failure::in_file(path)(error),
        None => Failure::from(error),
    };
    let (stream, cloud) = match stream.starts_with(load::PLY_MAGIC) {
        true => {
            progress.say("encode");
            let (stream, cloud) = coded(&stream, &file, limits).map_err(in_input)?;
            (stream, Some(cloud))
        }
        false => (stream, None),
    };
    let subject = Subject {
        stream: &stream,
        model: &|| Model::from_bytes(&file),
        cloud: cloud.as_ref(),
        limits,
    };
    let options = Options {
        size: [args.size.0, args.size.1],
        views: args.views,
        repeats: args.repeat,
    };
    let report = tradeoff::run(&subject, &options, &|step| progress.say(step));
    let report = report.map_err(in_input)?;
    std::fs::create_dir_all(&args.output).map_err(|source| Error::Io {
        path: args.output.clone(),
        source,
    })?;
    let json =
        serde_json::to_string_pretty(&report).map_err(|e| Failure(format!("the report cannot be written: {e}")))?;
    let files = [
        ("tradeoff.json", json),
        ("tradeoff.svg", tradeoff::plot(&report)),
        ("tradeoff.html", tradeoff::page(&report)?),
    ];
    let mut text = summary(&report);
    text += "\nWritten:\n";
    for (name, content) in files {
        let path = args.output.join(name);
        output::write_file(&path, |w| {
            w.write_all(content.as_bytes()).map_err(|source| Error::Io {
                path: path.clone(),
                source,
            })
        })?;
        text += &format!("  {}\n", path.display());
    }
    Ok(text)
}

/// A point cloud's stream, and its voxels.
fn coded(ply: &[u8], model: &[u8], limits: &Limits) -> b2p::Result<(Vec<u8>, ColouredVoxels)> {
    let (cloud, _) = voxelise_closed(&PointCloud::from_ply(ply, limits)?)?;
    let (model, log) = (Model::from_bytes(model)?, &mut Log::default());
    let coded = encoder::encode(&cloud, &model, &encoder::Options::default(), log)?;
    Ok((coded.bytes, cloud))
}

fn summary(report: &Report) -> String {
    let [width, height] = report.size;
    let mut text = format!(
        "{}, {} cores, {}; {} views of {width}×{height}, medians of {} repeats\n\
         Accuracy against pictures in double precision: PSNR in dB, MS-SSIM, the worst pixel of 255.\n\
         ~ cannot be told from the default's time.\n\n",
        report.machine.processor, report.machine.cores, report.machine.isa, report.views, report.repeats,
    );
    let head = [
        "one knob at a time",
        "decode ms",
        "picture ms",
        "PSNR",
        "MS-SSIM",
        "worst",
        "MB at most",
    ];
    let mut rows = vec![head.map(String::from).to_vec()];
    if report.ladder.iter().any(|row| row.cloud_psnr.is_some()) {
        rows[0].push("PSNR, cloud".into());
    }
    rows.extend(report.ladder.iter().map(line));
    text += &table(&rows);
    rows.truncate(1);
    rows[0][0] = "combinations that no other beats".into();
    let mut front: Vec<&Row> = report.combinations.iter().filter(|r| r.on_front).collect();
    front.sort_by(|a, b| a.total.median.total_cmp(&b.total.median));
    rows.extend(front.into_iter().map(line));
    text += "\n";
    text += &table(&rows);
    for (title, cases) in [
        ("renderer: worst of 255", &report.renderer_cases),
        ("network: worst of 255", &report.network_cases),
    ] {
        let settings = cases.first().map_or(&[][..], |case| &case.errors);
        let mut rows = vec![vec![title.to_owned()]];
        rows[0].extend(settings.iter().map(|error| error.setting.clone()));
        for case in cases {
            let mut row = vec![case.name.clone()];
            row.extend(case.errors.iter().map(|error| format!("{:.2}", error.worst)));
            rows.push(row);
        }
        text += "\n";
        text += &table(&rows);
    }
    let head = ["effect", "scene", "called for", "off ms", "on ms", "worst"];
    let mut rows = vec![head.map(String::from).to_vec()];
    for cost in &report.effects {
        let same = if cost.verdict == Verdict::Same { "~" } else { "" };
        rows.push(vec![
            cost.effect.clone(),
            cost.scene.clone(),
            if cost.called_for { "yes" } else { "no" }.into(),
            format!("{:.1}", cost.off.median),
            format!("{same}{:.1}", cost.on.median),
            format!("{:.2}", cost.worst),
        ]);
    }
    text += "\n";
    text += &table(&rows);
    text
}

fn line(row: &Row) -> Vec<String> {
    let time = |spread: Spread, verdict| {
        let same = if verdict == Verdict::Same { "~" } else { "" };
        format!("{same}{:.1}", spread.median)
    };
    let mut cells = vec![
        row.name(),
        time(row.decode, row.decode_verdict),
        time(row.picture, row.picture_verdict),
        row.psnr.map_or("equal".into(), |db| format!("{db:.1}")),
        row.ms_ssim.map_or("-".into(), |s| format!("{s:.5}")),
        format!("{:.2}", row.worst),
        (row.most_memory / 1_000_000).to_string(),
    ];
    cells.extend(row.cloud_psnr.map(|db| format!("{db:.2}")));
    cells
}
