//! One object, and everything that is judged by it.

use b2p::Limits;
use b2p::cloud::{PointCloud, voxelise};
use b2p::container::Header;
use b2p::encoder::{Options, encode};
use b2p::gaussians::Heads;
use b2p::gaussians::{Frame, Gaussians};
use b2p::latents::LatentDecoder;
use b2p::latents::network::Model;
use b2p::log::Log;

use super::item::Content;
use super::picture::Picture;
use super::points::Points;
use super::protocol::{Judged, Truth, VIEWS};
use super::reframe::into_frame;
use super::report::{LevelRate, Rate, Row};
use super::surfels::{SLIM_BLUR, Surfels, WIDE_BLUR};
use crate::error::{LabError, Result};
use crate::surface::Surface;

/// Sides of squares that are tried, as multiples of the points' spacing.
const SIDES: [f64; 3] = [1.0, 1.3, 1.7];
/// Standard deviations of round Gaussians that are tried, as multiples of the mean distance to the nearest point; the
/// paper's is the first.
const SIGMAS: [f64; 4] = [1.0, 0.5, 0.35, 0.25];
/// Standard deviations of surfels in their plane that are tried, as multiples of the points' spacing.
const WIDTHS: [f64; 8] = [0.36, 0.42, 0.5, 0.6, 0.72, 1.0, 1.4, 2.0];

/// A mesh's pictures, and what else is known of it.
pub struct Bench {
    frame: Frame,
    truth: Truth,
    finest: Option<PointCloud>,
    points: Option<u64>,
    model: Option<Model>,
    levels: Option<Vec<u8>>,
    heads: Heads,
}

/// One way to draw one item, and how that looks.
#[derive(Debug, Clone)]
pub struct Entry {
    /// What it scored.
    pub row: Row,
    /// Its pictures, from azimuth 0 on.
    pub pictures: Vec<Picture>,
}

impl Bench {
    /// Draws the truth: a surface in world units, of which the cube that streams and clouds are in is `frame`'s.
    ///
    /// # Errors
    /// If no camera sees the surface.
    pub fn new(surface: &Surface, frame: Frame) -> Result<Self> {
        Bench::with_views(VIEWS, surface, frame)
    }

    fn with_views(count: usize, surface: &Surface, frame: Frame) -> Result<Self> {
        let in_cube = |p: [f32; 3]| frame.placement.to_cube(frame.bits, p.map(f64::from));
        Ok(Bench {
            frame,
            truth: Truth::from_first(count, &surface.map(in_cube))?,
            finest: None,
            points: None,
            model: None,
            levels: None,
            heads: Heads::Best,
        })
    }

    /// With the finest cloud: bits are counted over its points, and decoded clouds centred by it.
    ///
    /// # Errors
    /// If it is no cloud of voxels.
    pub fn with_cloud(mut self, cloud: PointCloud) -> Result<Self> {
        let voxels = voxelise(&cloud, Some(self.frame.bits))?.voxels;
        self.points = Some(voxels.len() as u64);
        self.finest = Some(cloud);
        Ok(self)
    }

    /// With Gaussians of streams made by these heads of the model.
    pub fn with_heads(mut self, heads: Heads) -> Self {
        self.heads = heads;
        self
    }

    /// With a model to code and decode streams, at these levels or at all that it can draw.
    pub fn with_model(mut self, model: Model, levels: Option<Vec<u8>>) -> Self {
        self.model = Some(model);
        self.levels = levels;
        self
    }

    /// The truth.
    pub fn truth(&self) -> &Truth {
        &self.truth
    }

    /// Points of the finest cloud, if there is one.
    pub fn points(&self) -> Option<u64> {
        self.points
    }

    /// Codes the finest cloud.
    ///
    /// # Errors
    /// If there is no cloud or no model, or it cannot be coded.
    pub fn encode(&self) -> Result<Vec<u8>> {
        let cloud = self.finest.as_ref();
        let cloud = cloud.ok_or_else(|| LabError::Usage("there is no cloud to code".into()))?;
        let voxels = voxelise(cloud, Some(self.frame.bits))?;
        let options = Options::default();
        Ok(encode(&voxels, self.model()?, &options, &Log::default())?.bytes)
    }

    /// Judges an item in every way there is to draw it. `bpp` is its rate, where it does not tell.
    ///
    /// # Errors
    /// If it cannot be decoded or drawn.
    pub fn judge(&self, name: &str, content: Content, bpp: Option<f64>) -> Result<Vec<Entry>> {
        let rate = bpp.map(|total| Rate {
            total,
            levels: Vec::new(),
        });
        let entry = |how: &str, primitives: usize, level, rate, judged: Judged| Entry {
            row: Row {
                name: name.to_owned(),
                drawn: how.to_owned(),
                level,
                rate,
                primitives,
                scores: judged.mean,
                views: judged.views,
            },
            pictures: judged.pictures,
        };
        match content {
            Content::Cloud(mut cloud) => {
                self.onto_grid(&mut cloud);
                let points = Points::on_grid(&cloud, self.frame.bits, self.finest.as_ref());
                let count = points.positions.len();
                let draw = |side| self.truth.judge(|camera| Ok(points.draw_squares(camera, side)));
                let (side, squares) = best(SIDES, draw)?;
                let draw = |sigma| self.gaussians(points.to_gaussians(self.frame, sigma));
                let (sigma, round) = best(SIGMAS, draw)?;
                let flat = Surfels::new(&points);
                let with = |blur| {
                    best(WIDTHS, |width| {
                        self.gaussians(flat.to_gaussians(self.frame, width, blur))
                    })
                };
                let (width, surfels) = with(WIDE_BLUR)?;
                let (slim_width, slim) = with(SLIM_BLUR)?;
                let [squares_are, round_are, surfels_are, slim_are] = [
                    format!("squares x{side}"),
                    format!("global Gaussian x{sigma}"),
                    format!("surfels x{width}"),
                    format!("slim surfels x{slim_width}"),
                ];
                Ok(vec![
                    entry(&squares_are, count, None, rate.clone(), squares),
                    entry(&round_are, count, None, rate.clone(), round),
                    entry(&surfels_are, count, None, rate.clone(), surfels),
                    entry(&slim_are, count, None, rate, slim),
                ])
            }
            Content::Gaussians(gaussians) => {
                let count = gaussians.len();
                let judged = self.gaussians(gaussians)?;
                Ok(vec![entry("Gaussians", count, None, rate, judged)])
            }
            Content::Stream(bytes) => {
                let header = Header::parse(&bytes, &Limits::default())?;
                let decoder = LatentDecoder::new(self.model()?).with_heads(self.heads)?;
                let levels = match &self.levels {
                    Some(levels) => levels.clone(),
                    None => decoder.levels(&bytes)?,
                };
                levels
                    .into_iter()
                    .map(|level| {
                        let rate = rate_of(&header, level, self.points)?;
                        let gaussians = decoder.decode(&bytes, Some(level), &Log::default())?;
                        let (how, count) = (format!("level {level}"), gaussians.len());
                        let judged = self.gaussians(gaussians)?;
                        Ok(entry(&how, count, Some(level), Some(rate), judged))
                    })
                    .collect()
            }
        }
    }

    /// Moves points that are not on a grid from the mesh's space to voxel coordinates.
    fn onto_grid(&self, cloud: &mut PointCloud) {
        if cloud.positions.iter().flatten().all(|x| x.fract() == 0.0) {
            return;
        }
        let half_side = f64::from(1u32 << self.frame.bits) / 2.0;
        for position in &mut cloud.positions {
            let in_cube = self.frame.placement.to_cube(self.frame.bits, *position);
            *position = in_cube.map(|x| (f64::from(x) + 1.0) * half_side - 0.5);
        }
    }

    fn model(&self) -> Result<&Model> {
        let missing = || LabError::Usage("streams need a model: name one with --model".into());
        self.model.as_ref().ok_or_else(missing)
    }

    fn gaussians(&self, gaussians: Gaussians) -> Result<Judged> {
        self.truth.judge_gaussians(&into_frame(gaussians, self.frame))
    }
}

/// The best of some sizes, by PSNR over whole pictures. It has one peak over the sizes, which are in order: none after
/// a fall is tried.
fn best<const N: usize>(sizes: [f64; N], judge: impl Fn(f64) -> Result<Judged>) -> Result<(f64, Judged)> {
    let mut best: Option<(f64, Judged)> = None;
    for size in sizes {
        let judged = judge(size)?;
        let falls = |(_, other): &(f64, Judged)| judged.mean.psnr <= other.mean.psnr;
        if best.as_ref().is_some_and(falls) {
            break;
        }
        best = Some((size, judged));
    }
    Ok(best.expect("the first size beats none"))
}

/// What a stream costs up to a level, over `points` or the points that it says it was made of.
fn rate_of(header: &Header, level: u8, points: Option<u64>) -> Result<Rate> {
    let points = points.unwrap_or(header.points) as f64;
    let bpp = |bytes: u64| 8.0 * bytes as f64 / points;
    let sections = (header.base..=level).zip(&header.sections);
    Ok(Rate {
        total: bpp(header.prefix_bytes(level)?),
        levels: sections
            .map(|(level, section)| LevelRate {
                level,
                geometry: bpp(section.geometry.into()),
                features: bpp(section.colours.into()),
            })
            .collect(),
    })
}

#[cfg(test)]
mod tests {
    use b2p::latents::network::{Shape, untrained};
    use glam::Vec3;

    use super::*;
    use crate::mesh::Mesh;
    use crate::procedural::{pattern, shapes};
    use crate::sample::{Grid, Sampler};

    const BITS: u8 = 6;

    /// A ball, its cloud on a grid of 64³, and a bench of two views with a model that has learned nothing.
    fn bench() -> Bench {
        let paint = pattern::checker(0.3, Vec3::new(0.9, 0.2, 0.1), Vec3::new(0.1, 0.3, 0.8));
        let surface = Surface::new(&Mesh {
            parts: vec![shapes::sphere().part(40.0, &paint, None)],
        });
        let grid = Grid::fit(surface.bounds(), BITS, 0.95).unwrap();
        let sampled = Sampler::new(&surface, grid, 200_000, 0).unwrap().cloud(None);
        let frame = Frame {
            bits: BITS,
            placement: grid.placement(),
        };
        let cloud = PointCloud {
            positions: sampled
                .keys
                .iter()
                .map(|&k| b2p::geometry::morton::decode(k).map(f64::from))
                .collect(),
            colours: sampled.rgb,
            ..PointCloud::default()
        };
        let model = Model::from_bytes(&untrained(&Shape::tiny(), 1)).unwrap();
        let bench = Bench::with_views(2, &surface, frame).unwrap();
        bench.with_cloud(cloud).unwrap().with_model(model, None)
    }

    #[test]
    fn a_coded_cloud_is_judged_at_every_level_that_can_be_drawn_and_costs_its_prefix() {
        let bench = bench();
        let bytes = bench.encode().unwrap();
        let points = bench.points().unwrap();
        let entries = bench.judge("coded", Content::Stream(bytes.clone()), None).unwrap();
        let levels: Vec<_> = entries.iter().map(|e| e.row.level.unwrap()).collect();
        assert_eq!(levels, [4, 5]);
        for entry in &entries {
            let rate = entry.row.rate.as_ref().unwrap();
            let parts: f64 = rate.levels.iter().map(|l| l.geometry + l.features).sum();
            assert!(parts < rate.total);
            assert!((rate.total - parts) * points as f64 / 8.0 < 200.0, "a header is small");
            assert_eq!(entry.pictures.len(), 2);
        }
        let whole = entries[1].row.rate.as_ref().unwrap().total;
        assert_eq!((whole * points as f64 / 8.0).round() as usize, bytes.len());
    }

    #[test]
    fn a_cloud_is_drawn_in_four_ways_and_keeps_the_rate_it_was_given() {
        let bench = bench();
        let cloud = bench.finest.clone().unwrap();
        let entries = bench.judge("cloud", Content::Cloud(cloud), Some(0.5)).unwrap();
        assert!(entries[0].row.drawn.starts_with("squares x"));
        assert!(entries[1].row.drawn.starts_with("global Gaussian x"));
        assert!(entries[2].row.drawn.starts_with("surfels x"));
        assert!(entries[3].row.drawn.starts_with("slim surfels x"));
        for entry in &entries {
            assert_eq!(entry.row.rate.as_ref().unwrap().total, 0.5);
        }
        let [squares, round, surfels] = [0, 1, 2].map(|i| entries[i].row.scores.psnr);
        assert!(squares > 10.0 && round > 10.0, "{squares} {round}");
        assert!(surfels > squares, "{surfels} {squares}");
    }

    #[test]
    fn a_stream_without_a_model_is_an_error_that_says_what_to_do() {
        let mut bench = bench();
        let bytes = bench.encode().unwrap();
        bench.model = None;
        let error = bench.judge("coded", Content::Stream(bytes), None).unwrap_err();
        assert!(error.to_string().contains("--model"));
    }
}
