use super::*;
use crate::Width;
use crate::apart::{Link, Pair};
use crate::bodies::Body;
use crate::chain::{Frame, Joint};
use crate::obstacle::{Core, Obstacle};

/// Numbers from -1 to 1 that look random.
struct Numbers(u64);

impl Numbers {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }
}

const LENGTH: f64 = 0.3;

/// Turns about z by an angle, then about x by a quarter turn if `bent`.
fn frame(angle: f64, bent: bool, translation: [f64; 3]) -> Frame {
    let (s, c) = angle.sin_cos();
    let [y, z] = if bent { [[0.0, 0.0, 1.0], [s, -c, 0.0]] } else { [[-s, c, 0.0], [0.0, 0.0, 1.0]] };
    Frame { rotation: [[c, s, 0.0], y, z], translation }
}

/// An arm of four links, whose joints turn about different axes, and a sliding finger; each link has two balls. A third
/// of the obstacles are boxes, cylinders, and points.
fn scene(numbers: &mut Numbers, width: Width) -> Arc<Scene> {
    let mut bodies = vec![Body::Fixed(frame(0.0, false, [0.0; 3]))];
    let angles: Vec<f64> = (0..4).map(|i| if i == 2 { 0.4 } else { 0.0 }).collect();
    for (i, angle) in angles.iter().enumerate() {
        let origin = frame(*angle, i % 2 == 1, [0.0, 0.0, if i == 0 { 0.1 } else { LENGTH }]);
        let joint =
            Joint { origin, slides: i == 3, variable: i, multiplier: if i == 1 { -1.0 } else { 1.0 }, offset: 0.1 };
        bodies.push(Body::Moving { parent: i, joint });
    }
    let mut place = || [0.7 * numbers.next(), 0.7 * numbers.next(), 0.7 * numbers.next()];
    let obstacles: Vec<Obstacle> = (0..21)
        .map(|i| {
            let frame = frame(place()[0] * 4.0, i % 2 == 0, place());
            let core = match i % 3 {
                0 => Core::Box { frame, half: [0.05, 0.1, 0.02] },
                1 => Core::Cylinder { frame, half: 0.1, radius: 0.05 },
                _ => {
                    bodies.push(Body::Fixed(frame));
                    Core::Cover { body: bodies.len() - 1, tree: Arc::new(Tree::of_segment(0.05)), extent: 2.0 }
                }
            };
            Obstacle { core, radius: 0.01 }
        })
        .collect();
    let tree = Arc::new(Tree::of_segment(0.5 * LENGTH));
    let link = |body: usize| Link { body, tree: tree.clone(), extent: 2.0 };
    let links: Vec<Link> = (1..=4).map(link).collect();
    let mut pairs: Vec<Pair> = (0..4).flat_map(|l| (0..21).map(move |o| Pair::Obstacle(l, o))).collect();
    pairs.extend([Pair::Links(0, 2), Pair::Links(0, 3), Pair::Links(1, 3)]);
    Arc::new(Scene::new(bodies, links, &obstacles, &pairs, width))
}

/// The most that any point of the arm moves, for each joint [m/rad or m/m].
const LEVERS: [f64; 4] = [1.3, 1.0, 0.7, 1.0];

fn check(discrete: &Discrete, from: &[f64], to: &[f64], blocks: usize, swept: bool) -> Option<u32> {
    check_from(0, discrete, from, to, blocks, swept)
}

/// Leaves the first blocks out.
fn check_from(
    skipped: usize,
    discrete: &Discrete,
    from: &[f64],
    to: &[f64],
    blocks: usize,
    swept: bool,
) -> Option<u32> {
    let moved: Vec<f64> = from.iter().zip(to).map(|(a, b)| (b - a).abs()).collect();
    let reach = vec![moved.iter().zip(LEVERS).map(|(d, lever)| d * lever * 2.0).sum::<f64>(); 90];
    let proof = if swept { Proof::Motion { reach: &reach, part: 1.0, turn: moved.iter().sum() } } else { Proof::None };
    let motion = Motion { from, to, blocks, skipped, pads: &[0.003; 90], pad: 0.003, likely: None, proof };
    discrete.touching(&motion, &mut Buffers::default())
}

/// The same scene, checked on every width.
fn on_every_width(numbers: &mut Numbers) -> Vec<Discrete> {
    let state = numbers.0;
    let mut on = |width| {
        numbers.0 = state;
        Discrete::new(scene(numbers, width))
    };
    Width::usable().into_iter().map(&mut on).collect()
}

#[test]
fn a_swept_motion_touches_nowhere_and_what_touches_is_found() {
    let mut numbers = Numbers(5);
    let (mut proven, mut touching, mut between, mut only_rest) = (0, 0, 0, 0);
    for _ in 0..12 {
        let scenes = on_every_width(&mut numbers);
        for _ in 0..60 {
            let mut q = || -> Vec<f64> { [2.0, 2.0, 2.0, 0.2].map(|most| most * numbers.next()).to_vec() };
            let (from, aim) = (q(), q());
            let to: Vec<f64> = from.iter().zip(&aim).map(|(a, b)| a + 0.3 * (b - a)).collect();
            for swept in [false, true] {
                let found = check(&scenes[0], &from, &to, 2, swept);
                assert!(scenes.iter().all(|scene| check(scene, &from, &to, 2, swept) == found), "{from:?} {to:?}");
            }
            let (looks, swept) = (check(&scenes[0], &from, &to, 2, false), check(&scenes[0], &from, &to, 2, true));
            let fine = check(&scenes[0], &from, &to, 64, false);
            // The samples of the coarse check are among those of the fine one.
            assert!(looks.is_none() || fine.is_some());
            // So is the first block, which all numbers of blocks have.
            let (first, rest) =
                (check(&scenes[0], &from, &to, 1, false), check_from(1, &scenes[0], &from, &to, 2, false));
            assert_eq!(looks.is_some(), first.is_some() || rest.is_some());
            only_rest += usize::from(first.is_none() && rest.is_some());
            assert!(swept.is_some() || fine.is_none(), "{from:?} to {to:?} is proven and touches");
            proven += usize::from(swept.is_none());
            touching += usize::from(looks.is_some());
            between += usize::from(looks.is_none() && fine.is_some());
        }
    }
    assert!(proven > 60 && touching > 60 && between > 0, "{proven} proven, {touching} touching, {between} between");
    assert!(only_rest > 0, "{only_rest}");
}

#[test]
fn the_pair_that_touches_is_named() {
    let mut numbers = Numbers(9);
    let scene = scene(&mut numbers, Width::widest());
    let discrete = Discrete::new(scene.clone());
    let mut found = 0;
    for _ in 0..200 {
        let q = [2.0, 2.0, 2.0, 0.2].map(|most| most * numbers.next());
        let Some(pair) = check(&discrete, &q, &q, 1, false) else { continue };
        // The other kernel finds the same pair close at this configuration.
        let lanes: Vec<Lanes> = q.iter().map(|x| Lanes::splat(*x as f32)).collect();
        let stretches = crate::apart::Stretches {
            q: &lanes,
            half: 0.0,
            lanes: u16::MAX,
            reach: &[0.0; 90],
            pads: &[0.003; 90],
            likely: None,
            ends_at_touch: false,
        };
        let mut close = Vec::new();
        scene.close(&stretches, &[pair], &mut crate::apart::Buffers::default(), &mut close);
        assert_eq!(close, [(pair, u16::MAX)], "{q:?}");
        found += 1;
    }
    assert!(found > 20, "{found}");
}

#[test]
fn each_lane_has_the_verdict_that_it_has_alone() {
    let mut numbers = Numbers(21);
    let (mut touching, mut free) = (0, 0);
    for _ in 0..12 {
        let scenes = on_every_width(&mut numbers);
        // Pairs that touched before are compared first: that changes nothing.
        let mut buffers = vec![Buffers::default(); scenes.len()];
        for round in 0..40_u16 {
            let lanes: [[f64; 4]; LANES] =
                std::array::from_fn(|_| [2.0, 2.0, 2.0, 0.2].map(|most| most * numbers.next()));
            let q: Vec<Lanes> = (0..4).map(|j| Lanes(std::array::from_fn(|k| lanes[k][j] as f32))).collect();
            let sought = u16::MAX ^ (round.wrapping_mul(0x9e37) & 0x5a5a);
            let found: Vec<u16> = scenes
                .iter()
                .zip(&mut buffers)
                .map(|(scene, buffers)| scene.touching_lanes(&q, (&[0.003; 90], 0.003), sought, buffers))
                .collect();
            assert!(found.iter().all(|other| *other == found[0]), "{found:?}");
            for (lane, q) in lanes.iter().enumerate() {
                let alone = check(&scenes[0], q, q, 1, false).is_some();
                let (asked, touches) = (sought >> lane & 1 == 1, found[0] >> lane & 1 == 1);
                assert_eq!(touches, asked && alone, "{q:?}");
                touching += usize::from(asked && alone);
                free += usize::from(asked && !alone);
            }
        }
    }
    assert!(touching > 500 && free > 500, "{touching} touching, {free} free");
}
