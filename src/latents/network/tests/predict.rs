//! What predicts latents from neighbours, against its definition.

use b2p_kernels::Isa;

use super::super::reference::{Mode, Oracle};
use super::super::{Model, Pass, Shape, untrained};
use super::definition::{latents, shapes};
use super::{Cloud, all_passes, rows};
use crate::latents::entropy::UNPREDICTED;

#[test]
fn the_base_level_is_predicted_as_defined_to_the_bit_on_every_isa() {
    let cloud = Cloud::sheet();
    // Role 1's voxels are more than role 0's: any level serves.
    let (map, sites) = (&cloud.maps[1], cloud.sites(1));
    let octants = cloud.octree.level(cloud.level(1)).octants();
    for (seed, shape) in (20..).zip(shapes()).filter(|(_, s)| s.base_channels > 0) {
        let bytes = untrained(&shape, seed);
        let (k, y) = (shape.latents, latents(map.len() * shape.latents));
        let oracle = Oracle::new(&bytes, Mode::Whole);
        let (want_mu, want_sigma, known) = oracle.base(&sites, &rows(&y, k));
        assert!(known.contains(&true) && known.contains(&false));
        for isa in Isa::available() {
            let model = Model::from_bytes(&bytes).unwrap().with_isa(isa);
            let (mu, sigma) = all_passes(&model, 0, &octants, map, &y, None);
            assert!(rows(&mu, k) == want_mu, "means: {isa}");
            for ((got, want), known) in sigma.chunks(k).zip(&want_sigma).zip(&known) {
                let unpredicted = vec![UNPREDICTED; k];
                match known {
                    true => assert!(rows(got, k)[0] == *want, "scales: {isa}"),
                    false => assert_eq!(got, unpredicted, "{isa}"),
                }
            }
        }
    }
}

/// Means and scale indices of no particular meaning.
fn parameters(count: usize) -> (Vec<i16>, Vec<u8>) {
    (0..count)
        .map(|i| ((i * 37 % 400) as i16 - 200, (i * 29 % 64) as u8))
        .unzip()
}

#[test]
fn higher_levels_are_corrected_from_neighbours_as_defined_to_the_bit_on_every_isa() {
    let cloud = Cloud::sheet();
    for (seed, shape) in (40..).zip(shapes()) {
        let bytes = untrained(&shape, seed);
        let oracle = Oracle::new(&bytes, Mode::Whole);
        for role in [1, 2].into_iter().filter(|r| shape.near_channels[r - 1] > 0) {
            let (map, sites) = (&cloud.maps[role], cloud.sites(role));
            let octants = cloud.octree.level(cloud.level(role)).octants();
            let (k, y) = (shape.latents, latents(map.len() * shape.latents));
            let (mu, sigma) = parameters(y.len());
            let real = sigma.iter().map(|&s| s.into()).collect::<Vec<i16>>();
            let level = (&rows(&mu, k), &rows(&real, k));
            let (want_mu, want_sigma) = oracle.near(role, &sites, &rows(&y, k), level);
            assert!(want_mu != *level.0 && want_sigma != *level.1);
            for isa in Isa::available() {
                let model = Model::from_bytes(&bytes).unwrap().with_isa(isa);
                assert!(model.has_passes(role));
                let level = Some((&mu[..], &sigma[..]));
                let got = all_passes(&model, role, &octants, map, &y, level);
                assert!(rows(&got.0, k) == want_mu, "means: {isa}, role {role}");
                assert!(rows(&got.1, k) == want_sigma, "scales: {isa}, role {role}");
            }
        }
    }
}

#[test]
fn a_pass_is_predicted_from_earlier_voxels_of_its_slice_alone() {
    let cloud = Cloud::sheet();
    let map = &cloud.maps[1];
    let octants = cloud.octree.level(cloud.level(1)).octants();
    let model = Model::from_bytes(&untrained(&Shape::tiny(), 3)).unwrap();
    let (k, slice) = (model.shape().latents, map.len() / 4..map.len() / 2);
    let y = latents(slice.len() * k);
    let (mu, sigma) = parameters(map.len() * k);
    for (role, level) in [(0, None), (1, Some((&mu[..], &sigma[..])))] {
        for octant in 0..8 {
            let pass: Vec<u32> = slice
                .clone()
                .filter(|&v| octants[v] == octant)
                .map(|v| v as u32)
                .collect();
            let parameters = |y: &[i16]| {
                let pass = Pass {
                    octants: &octants,
                    map,
                    slice: slice.clone(),
                    voxels: &pass,
                    latents: y,
                };
                model.pass_parameters(role, &pass, level)
            };
            let mut later = y.clone();
            for (v, y) in slice.clone().zip(later.chunks_exact_mut(k)) {
                if octants[v] >= octant {
                    y.fill(i16::MIN);
                }
            }
            assert!(parameters(&y) == parameters(&later), "role {role}, octant {octant}");
            let at = |v: &u32| *v as usize * k..(*v as usize + 1) * k;
            let known = match level {
                None => parameters(&y).1.iter().any(|&sigma| sigma != UNPREDICTED),
                Some((mu, _)) => parameters(&y).0 != pass.iter().flat_map(|v| &mu[at(v)]).copied().collect::<Vec<_>>(),
            };
            assert_eq!(known, octant > 0, "role {role}, octant {octant}");
        }
    }
}
