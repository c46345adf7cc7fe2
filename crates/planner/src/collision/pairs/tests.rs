//! Closed forms against parry, and against dense samples where parry is not exact.

use std::sync::Arc;

use glamx::{DAffine3, DQuat, DVec3};

use super::super::cloud::Cloud;
use super::super::shape::{Mesh, Solid};
use super::*;
use dimos_robot::random::Random;

fn vector(random: &mut Random, size: f64) -> DVec3 {
    DVec3::new(random.between(-size, size), random.between(-size, size), random.between(-size, size))
}

fn somewhere(random: &mut Random) -> DAffine3 {
    let axis = vector(random, 1.0).normalize_or(DVec3::Z);
    let turn = DQuat::from_axis_angle(axis, random.between(-3.0, 3.0));
    // Right angles are the hard cases: parallel edges and faces.
    let turn = if random.below(4) == 0 { DQuat::from_rotation_x(std::f64::consts::FRAC_PI_2) } else { turn };
    DAffine3::from_rotation_translation(turn, vector(random, 0.6))
}

fn cube(size: DVec3) -> (Vec<DVec3>, Vec<[u32; 3]>) {
    let h = size * 0.5;
    let corner = |i: u32| {
        let sign = |bit: u32| if i >> bit & 1 == 0 { -1.0 } else { 1.0 };
        h * DVec3::new(sign(0), sign(1), sign(2))
    };
    let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let triangles = quads.iter().flat_map(|q| [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]).collect();
    ((0..8).map(corner).collect(), triangles)
}

fn solid(kind: usize, random: &mut Random) -> Solid {
    let size = DVec3::new(random.between(0.05, 0.5), random.between(0.05, 0.5), random.between(0.05, 0.5));
    let at = somewhere(random);
    match kind {
        0 => Solid::sphere(size.x, at),
        1 => Solid::capsule(size.x * 0.5, size.y, at),
        2 => Solid::cuboid(size, at),
        3 => Solid::cylinder(size.x * 0.5, size.y, at),
        4 => Solid::hull(&cube(size).0, at),
        _ => Solid::mesh(Arc::new(Mesh::new(cube(size).0, cube(size).1).unwrap()), at),
    }
    .unwrap()
}

#[test]
fn every_pair_agrees_with_parry() {
    let mut random = Random::new(11);
    let still = DAffine3::IDENTITY;
    for round in 0..4000 {
        let (a, b) = (solid(round % 6, &mut random), solid(round / 6 % 6, &mut random));
        let (pa, pb) = (a.place(&still), b.place(&still));
        let (own, theirs) = (distance(&pa, &pb), general::distance(&pa, &pb));
        assert!((own - theirs).abs() < 1e-6, "{a:?}\n{b:?}\n{own} {theirs}");
        assert!((distance(&pb, &pa) - own).abs() < 1e-6);
        assert!(gap(&pa, &pb) <= own + 1e-9, "{} {own}", gap(&pa, &pb));
        for reach in [0.0, 0.05, 0.3] {
            let certain = (theirs - reach).abs() > 1e-6;
            assert!(!certain || within(&pa, &pb, reach) == (theirs <= reach), "{a:?}\n{b:?}\n{theirs} {reach}");
        }
        let nearest = general::nearest(&pa, &pb);
        assert!((nearest.distance.max(0.0) - theirs).abs() < 1e-6, "{nearest:?} {theirs}");
        let (ball, radius) = pa.ball();
        assert!((nearest.a - ball).length() <= radius + 1e-6);
    }
}

/// Distance of boxes that do not overlap: from corners to boxes, or between edges.
fn distance_of_boxes(f: &DAffine3, h: DVec3, g: &DAffine3, k: DVec3) -> f64 {
    let corners = |frame: &DAffine3, half: DVec3| -> Vec<DVec3> {
        let sign = |i: usize, bit: usize| if i >> bit & 1 == 0 { -1.0 } else { 1.0 };
        (0..8).map(|i| frame.transform_point3(half * DVec3::new(sign(i, 0), sign(i, 1), sign(i, 2)))).collect()
    };
    let (a, b) = (corners(f, h), corners(g, k));
    let edges = || (0..8_usize).flat_map(|i| (0..3).map(move |bit| (i, i | 1 << bit))).filter(|(i, j)| i != j);
    let to_boxes = a.iter().map(|p| point::cuboid(*p, g, k)).chain(b.iter().map(|p| point::cuboid(*p, f, h)));
    let of_edges = edges().flat_map(|(i, j)| edges().map(move |(m, n)| (i, j, m, n)));
    let of_edges = of_edges.map(|(i, j, m, n)| segment_segment::distance(a[i], a[j], b[m], b[n]));
    to_boxes.chain(of_edges).fold(f64::INFINITY, f64::min)
}

/// Links of a gripper that are parallel: parry found 18.8 mm instead of 6.6 mm between two of them.
#[test]
fn parallel_boxes_are_as_far_apart_as_they_are() {
    let mut random = Random::new(14);
    for round in 0..20_000 {
        let axis = [DVec3::X, DVec3::Y, DVec3::Z][round % 3];
        let turn = somewhere(&mut random).matrix3;
        let mut frame = || DAffine3 {
            matrix3: turn * glamx::DMat3::from_axis_angle(axis, random.between(-1.0, 1.0)),
            translation: turn * vector(&mut random, 0.2),
        };
        let (f, g) = (frame(), frame());
        let mut half =
            || DVec3::new(random.between(0.002, 0.05), random.between(0.002, 0.05), random.between(0.002, 0.05));
        let (h, k) = (half(), half());
        if box_box::gap(&f, h, &g, k) <= 0.0 {
            continue;
        }
        let (a, b) = (Placed::Box(f, h), Placed::Box(g, k));
        let exact = distance_of_boxes(&f, h, &g, k);
        assert!((distance(&a, &b) - exact).abs() < 1e-6, "{round}: {a:?}\n{b:?}\n{} {exact}", distance(&a, &b));
        for reach in [0.005, 0.02, 0.1] {
            let certain = (exact - reach).abs() > 1e-6;
            assert!(!certain || within(&a, &b, reach) == (exact <= reach), "{round}: {a:?}\n{b:?}\n{exact} {reach}");
        }
    }
}

#[test]
fn segments_and_boxes_agree_with_dense_samples() {
    let mut random = Random::new(12);
    for _ in 0..500 {
        let (frame, half) = (somewhere(&mut random), DVec3::new(0.1, 0.2, 0.3));
        let (a, b) = (vector(&mut random, 1.0), vector(&mut random, 1.0));
        let sampled = (0..=2000).map(|k| point::cuboid(a.lerp(b, f64::from(k) / 2000.0), &frame, half));
        let least = sampled.fold(f64::INFINITY, f64::min);
        let found = segment_box::distance(a, b, &frame, half);
        assert!(found <= least + 1e-9 && least - found < 2e-3, "{found} {least}");
    }
}

#[test]
fn boxes_inside_boxes_and_meshes_touch() {
    let still = DAffine3::IDENTITY;
    let (vertices, triangles) = cube(DVec3::ONE);
    let mesh = Mesh::new(vertices, triangles).unwrap();
    assert!(mesh.is_closed());
    let outer = Solid::mesh(Arc::new(mesh), still).unwrap();
    let inner = Solid::cuboid(DVec3::splat(0.1), still).unwrap();
    assert_eq!(distance(&outer.place(&still), &inner.place(&still)), 0.0);
    assert!(within(&outer.place(&still), &inner.place(&still), 0.0));
    let big = Solid::cuboid(DVec3::ONE, still).unwrap();
    assert!(within(&big.place(&still), &inner.place(&still), 0.0));
}

#[test]
fn clouds_agree_with_all_their_points() {
    let mut random = Random::new(13);
    let points: Vec<DVec3> = (0..777).map(|_| vector(&mut random, 0.5)).collect();
    let cloud = Cloud::new(points.iter().copied()).unwrap();
    assert_eq!(cloud.len(), 777);
    for round in 0..300 {
        let other = solid(round % 6, &mut random);
        let frame = somewhere(&mut random);
        let still = DAffine3::IDENTITY;
        let placed = other.place(&still);
        let each = points.iter().map(|p| distance(&Placed::Point(frame.transform_point3(*p)), &placed));
        let least = each.fold(f64::INFINITY, f64::min);
        let whole = Placed::Cloud(frame, &cloud);
        assert!((distance(&whole, &placed) - least).abs() < 1e-9);
        for reach in [0.0, 0.02, 0.2] {
            assert!((least - reach).abs() < 1e-9 || within(&whole, &placed, reach) == (least <= reach));
        }
    }
    assert!(Cloud::new([DVec3::NAN]).is_none());
}
