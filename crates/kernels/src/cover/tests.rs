use super::*;

/// Numbers from 0 to 1 that look random.
struct Numbers(u64);

impl Numbers {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }
}

/// Corners of a box, and its triangles in no particular orientation.
fn cuboid(half: Vector) -> Vec<[Vector; 3]> {
    let corner = |k: usize| std::array::from_fn(|i| if k >> i & 1 == 1 { half[i] } else { -half[i] });
    let faces = [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]];
    faces.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).map(|t| t.map(corner)).collect()
}

fn within(node: &Node, p: Vector) -> bool {
    vector::distance(node.center.map(f64::from), p) <= f64::from(node.radius)
}

/// Whether a point is in all balls from the first to one without parts.
fn covered(tree: &Tree, at: usize, p: Vector) -> bool {
    let node = &tree.nodes[at];
    let parts = node.first as usize..(node.first + node.count) as usize;
    within(node, p) && (node.count == 0 || parts.into_iter().any(|part| covered(tree, part, p)))
}

#[test]
fn every_point_of_a_solid_is_in_a_ball_without_parts() {
    let mut numbers = Numbers(1);
    for half in [[0.05, 0.05, 0.05], [0.02, 0.1, 0.3], [0.001, 0.2, 0.2]] {
        for inside in [Inside::Convex, Inside::Nothing] {
            let tree = Tree::of_triangles(cuboid(half).into_iter(), inside);
            for _ in 0..2000 {
                let mut p: Vector = half.map(|h| h * (2.0 * numbers.next() - 1.0));
                if matches!(inside, Inside::Nothing) {
                    // On the surface.
                    let axis = (3.0 * numbers.next()) as usize % 3;
                    p[axis] = half[axis].copysign(p[axis]);
                }
                assert!(covered(&tree, 0, p), "{p:?} of {half:?}");
            }
        }
    }
}

#[test]
fn what_is_inside_a_closed_surface_is_covered_too() {
    let half = [0.05, 0.1, 0.2];
    let test = |p: Vector| p.iter().zip(half).all(|(x, h)| x.abs() < h);
    let tree = Tree::of_triangles(cuboid(half).into_iter(), Inside::Test(&test));
    let mut numbers = Numbers(2);
    for _ in 0..2000 {
        let p: Vector = half.map(|h| h * (2.0 * numbers.next() - 1.0));
        assert!(covered(&tree, 0, p), "{p:?}");
    }
}

#[test]
fn balls_of_a_convex_solid_are_hardly_outside_and_inner_balls_are_inside() {
    let half = [0.05, 0.06, 0.15];
    let tree = Tree::of_triangles(cuboid(half).into_iter(), Inside::Convex);
    let mut worst: f64 = 0.0;
    let mut leaves = 0;
    for node in &tree.nodes {
        let depth = (0..3).map(|i| half[i] - f64::from(node.center[i]).abs()).fold(f64::INFINITY, f64::min);
        assert!(f64::from(node.inner) <= depth, "{node:?}: {depth}");
        if node.count == 0 {
            worst = worst.max(f64::from(node.radius) - depth);
            leaves += 1;
        }
    }
    assert!(worst < 0.009 && leaves <= LEAVES, "{worst} m outside, {leaves} balls");
}

#[test]
fn points_segments_and_joined_solids_are_covered() {
    let mut numbers = Numbers(3);
    let mut points: Vec<Vector> = (0..500).map(|_| std::array::from_fn(|_| numbers.next())).collect();
    points.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let cloud = Tree::of_sorted_points(&points);
    assert!(points.iter().all(|p| covered(&cloud, 0, *p)));
    let segment = Tree::of_segment(0.3);
    assert!((0..=100).all(|i| covered(&segment, 0, [0.0, 0.0, 0.006 * f64::from(i) - 0.3])));

    // About x by a quarter turn, then moved; radii grow.
    let place = Place {
        rotation: [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]],
        translation: [1.0, 2.0, 3.0],
        radius: 0.01,
    };
    let here =
        Place { rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], translation: [0.0; 3], radius: 0.0 };
    let joined = Tree::join(&[(&cloud, place), (&segment, here), (&Tree::of_point(), place)]);
    assert!(points.iter().all(|p| covered(&joined, 0, [1.0 + p[0], 2.0 - p[2], 3.0 + p[1]])));
    assert!(covered(&joined, 0, [0.0, 0.0, 0.29]) && covered(&joined, 0, [1.0, 2.0, 3.0099]));
    let number = |tree: &Tree| tree.nodes.len();
    assert_eq!(number(&joined), number(&cloud) + number(&segment) + 1 + 2);
}

#[test]
fn nothing_has_no_cover() {
    assert_eq!(Tree::of_triangles(std::iter::empty(), Inside::Convex), Tree::default());
    assert_eq!(Tree::of_sorted_points::<Vector>(&[]), Tree::default());
    assert_eq!(Tree::join(&[]), Tree::default());
}
