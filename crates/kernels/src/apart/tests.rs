use super::*;
use crate::chain::{Frame, Joint};
use crate::cover::Tree;

const HERE: Frame = Frame { rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], translation: [0.0; 3] };

fn at(x: f64) -> Frame {
    Frame { translation: [x, 0.0, 0.0], ..HERE }
}

fn slide() -> Body {
    // Along x: z of the joint's frame is the world's x.
    let origin = Frame { rotation: [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], translation: [0.0; 3] };
    let joint = Joint { origin, slides: true, variable: 0, multiplier: 1.0, offset: 0.0 };
    Body::Moving { parent: 0, joint }
}

/// A point that slides along x towards a ball of 0.1 m at 1 m, a cylinder and a cloud of one point at the same place.
fn scene(width: Width) -> Scene {
    let point = Arc::new(Tree::of_point());
    let obstacles = [
        Obstacle { core: Core::Box { frame: at(1.0), half: [0.0; 3] }, radius: 0.1 },
        Obstacle { core: Core::Cylinder { frame: at(1.0), half: 0.2, radius: 0.1 }, radius: 0.0 },
        Obstacle { core: Core::Cover { body: 2, tree: point.clone(), extent: 1.0 }, radius: 0.1 },
    ];
    let links = vec![Link { body: 1, tree: point, extent: 2.0 }];
    let pairs = [Pair::Obstacle(0, 0), Pair::Obstacle(0, 1), Pair::Obstacle(0, 2)];
    Scene::new(vec![Body::Fixed(HERE), slide(), Body::Fixed(at(1.0))], links, &obstacles, &pairs, width)
}

fn close(scene: &Scene, q: &Lanes, half: f32, reach: f64, pad: f64) -> (Option<u32>, Vec<(u32, u16)>) {
    let mut found = Vec::new();
    let (reach, pads) = ([reach; 3], [pad; 3]);
    let q = std::slice::from_ref(q);
    let stretches =
        Stretches { q, half, lanes: u16::MAX, reach: &reach, pads: &pads, likely: None, ends_at_touch: true };
    let touching = scene.close(&stretches, &[0, 1, 2], &mut Buffers::default(), &mut found);
    (touching, found)
}

#[test]
fn a_pair_is_apart_beyond_padding_and_motion_and_touches_within_the_padding() {
    let rounding = rounding(2.0, 1.5);
    for width in Width::usable() {
        let scene = scene(width);
        // The surface is at 0.9 m. All lanes are apart but the last, which is nearer than motion and padding.
        let mut q = Lanes::splat(0.9 - 0.06 - 2.0 * rounding);
        assert_eq!(close(&scene, &q, 0.1, 0.5, 0.01), (None, vec![]));
        q.0[15] = 0.9 - 0.06 + 2.0 * rounding;
        assert_eq!(close(&scene, &q, 0.1, 0.5, 0.01), (None, vec![(0, 1 << 15), (1, 1 << 15), (2, 1 << 15)]));
        // Without motion the same place is apart; within the padding it touches.
        assert_eq!(close(&scene, &q, 0.0, 0.5, 0.01), (None, vec![]));
        q.0[3] = 0.9 - 0.01 + 2.0 * rounding;
        assert_eq!(close(&scene, &q, 0.0, 0.5, 0.01).0, Some(0));
        // NaN is never apart.
        q.0[3] = f32::NAN;
        assert_ne!(close(&scene, &q, 0.0, 0.5, 0.01), (None, vec![]));
    }
}

#[test]
fn all_widths_find_the_same() {
    let widths = Width::usable();
    for step in 0..200 {
        let q = Lanes(std::array::from_fn(|lane| 0.7 + 0.0001 * (16 * step + lane) as f32));
        let found = |width: &Width| close(&scene(*width), &q, 0.05, 1.0, 0.02);
        assert!(widths.iter().all(|width| found(width) == found(&widths[0])), "{step}");
    }
}
