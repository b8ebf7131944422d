//! `b2p-lab closeup`

use std::path::PathBuf;

use b2p::cloud::{PointCloud, voxelise_closed};
use b2p::container::Header;
use b2p::gaussians::learned::HeadsModel;
use b2p::gaussians::{Frame, Gaussians, HeadSet};
use b2p::renderer::Renderer;
use b2p::renderer::camera::Camera;
use b2p::{Decoder, Limits, embedded};

use crate::error::{LabError, Result};
use crate::eval::picture::Picture;
use crate::eval::points::Points;
use crate::eval::sheet::{SheetRow, contact_sheet};
use crate::eval::surfels::{Surfels, WIDE_BLUR};
use crate::sample::write_bytes;
use crate::surface::Surface;
use crate::tradeoff::{of_cloud, of_mesh};

/// Draw a mesh from close up beside streams of it, with the best heads in a first row and with surfels, beside the
/// exact voxels, in a second; clouds of a peer, drawn as surfels, are a third (PNG)
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Streams of version 3
    #[arg(required = true, value_name = "IN.b2p")]
    streams: Vec<PathBuf>,
    /// The mesh, .glb or procedural:NAME
    #[arg(long, value_name = "MESH", default_value = "procedural:scene")]
    mesh: PathBuf,
    /// The cloud that was coded
    #[arg(long, value_name = "CLOUD.ply")]
    cloud: PathBuf,
    /// Clouds that a peer decoded, with their bits per point: coordinates are those of CLOUD
    #[arg(long, num_args = 1.., value_name = "PEER.ply@BPP")]
    peer: Vec<String>,
    /// What the peer is called
    #[arg(long, value_name = "NAME", default_value = "TMC13")]
    peer_name: String,
    /// The picture to write
    #[arg(short, long, value_name = "OUT.png")]
    output: PathBuf,
    /// Distance of the camera from the centre of the cube
    #[arg(long, default_value_t = 1.2)]
    radius: f64,
    /// Azimuth and elevation of the camera in degrees
    #[arg(long, num_args = 2, value_names = ["AZ", "EL"], default_values_t = [20.0, 20.0], allow_hyphen_values = true)]
    angles: Vec<f64>,
}

/// The standard deviation of a peer's surfels, as a multiple of the points' spacing: the best of three for sequences.
const PEER_WIDTH: f64 = 0.5;
/// Width and height of each picture.
const SIZE: [u32; 2] = [396, 300];

impl Args {
    /// Draws and writes.
    ///
    /// # Errors
    /// If something cannot be read, decoded or written.
    pub fn run(self) -> Result<()> {
        let limits = Limits::default();
        let [width, height] = SIZE;
        let camera = Camera::orbit(self.angles[0], self.angles[1], self.radius, 45.0, width, height)?;
        let read = |path: &PathBuf| std::fs::read(path).map_err(LabError::io(path));
        let draw = |gaussians: &Gaussians| -> Result<Picture> {
            Ok(Picture::from(&Renderer::new().render(gaussians, &camera)?))
        };
        let points = PointCloud::from_ply(&read(&self.cloud)?, &limits)?;
        let (cloud, _) = voxelise_closed(&points)?;
        let surface = Surface::new(&super::load_mesh(&self.mesh)?);
        let to_cube = |p: [f32; 3]| cloud.placement.to_cube(cloud.voxels.depth(), p.map(f64::from));
        let truth = Picture::from(&of_mesh(&surface.map(to_cube), &camera));
        let voxels = draw(&of_cloud(&cloud)?)?;

        let decoder = Decoder::new().with_heads_model(HeadsModel::from_bytes(embedded::HEADS)?);
        let mut rows = [(HeadSet::Best, vec![truth]), (HeadSet::Surfels, vec![voxels])];
        let mut rates = Vec::new();
        for path in &self.streams {
            let bytes = read(path)?;
            let points = Header::parse(&bytes, &limits)?.points.max(1);
            rates.push(format!("{:.2}", 8.0 * bytes.len() as f64 / points as f64));
            for (heads, pictures) in &mut rows {
                pictures.push(draw(&decoder.clone().with_heads(*heads).decode(&bytes)?)?);
            }
        }
        let mut labels = Vec::new();
        for (heads, _) in &rows {
            let first = if *heads == HeadSet::Best {
                "mesh"
            } else {
                "exact voxels"
            };
            labels.push(format!("{first} | {} bits per point, {heads}", rates.join(" | ")));
        }
        let mut rows: Vec<Vec<Picture>> = rows.into_iter().map(|(_, pictures)| pictures).collect();
        if !self.peer.is_empty() {
            let frame = Frame {
                bits: cloud.voxels.depth(),
                placement: cloud.placement,
            };
            let clouds = self.clouds(&points)?;
            let rates: Vec<&str> = clouds[1..].iter().map(|(_, rate)| rate.as_str()).collect();
            let rates = rates.join(" | ");
            labels.push(format!("cloud | {rates} bits per point, {} as surfels", self.peer_name));
            let mut pictures = Vec::new();
            for (cloud, _) in &clouds {
                let points = Points::on_grid(cloud, frame.bits, Some(&clouds[0].0));
                pictures.push(draw(&Surfels::new(&points).to_gaussians(frame, PEER_WIDTH, WIDE_BLUR))?);
            }
            rows.push(pictures);
        }
        let rows: Vec<SheetRow> = labels
            .into_iter()
            .zip(&rows)
            .map(|(label, pictures)| SheetRow {
                label,
                pictures: pictures.iter().collect(),
            })
            .collect();
        let sheet = contact_sheet(&rows, [0, 0, width as usize, height as usize]);
        write_bytes(&self.output, &sheet.to_png()?)
    }

    /// The cloud that was coded, and those of the peer with their bits per point.
    fn clouds(&self, points: &PointCloud) -> Result<Vec<(PointCloud, String)>> {
        let mut clouds = vec![(points.clone(), String::new())];
        for item in &self.peer {
            let wrong = || LabError::Usage(format!("--peer {item}: expected PEER.ply@BPP"));
            let (path, rate) = item.rsplit_once('@').ok_or_else(wrong)?;
            let rate: f64 = rate.parse().map_err(|_| wrong())?;
            let bytes = std::fs::read(path).map_err(LabError::io(std::path::Path::new(path)))?;
            clouds.push((PointCloud::from_ply(&bytes, &Limits::default())?, format!("{rate:.2}")));
        }
        Ok(clouds)
    }
}
