//! The joints between the root and one link, prepared for lanes.
//!
//! The frame of a joint may be rotated about the joint's own axis as one likes. Each is chosen so that what remains
//! between two joints is a translation and a rotation about x: R = Rz(a) · Rx(α) · Rz(b), where Rz(a) is added to the
//! joint before and Rz(b) is passed on to the joint after. For most arms α is a quarter turn, which costs nothing.

/// A rotation by its columns, and a translation [m].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame {
    /// The axes x, y, z.
    pub rotation: [[f64; 3]; 3],
    /// The origin [m].
    pub translation: [f64; 3],
}

impl Frame {
    fn times(&self, other: &Self) -> Self {
        let turned = other.rotation.map(|column| self.turn(column));
        let mut translation = self.turn(other.translation);
        translation.iter_mut().zip(self.translation).for_each(|(sum, t)| *sum += t);
        Self { rotation: turned, translation }
    }

    fn turn(&self, v: [f64; 3]) -> [f64; 3] {
        let [x, y, z] = self.rotation;
        std::array::from_fn(|i| x[i] * v[0] + y[i] * v[1] + z[i] * v[2])
    }

    fn about_z(angle: f64) -> Self {
        let (s, c) = angle.sin_cos();
        Self { rotation: [[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]], translation: [0.0; 3] }
    }
}

/// A joint that turns about, or slides along, the z axis of its frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Joint {
    /// Its frame at zero, in the frame of the joint before; of the first one, in the root.
    pub origin: Frame,
    /// Whether it slides.
    pub slides: bool,
    /// Index in a configuration.
    pub variable: usize,
    /// Its position is `multiplier · q + offset` [rad or m].
    pub multiplier: f64,
    /// See `multiplier`.
    pub offset: f64,
}

/// The rotation between two joints.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Bend {
    /// None.
    Straight,
    /// A quarter turn about x.
    Quarter,
    /// A quarter turn about x, backwards.
    QuarterBack,
    /// About x; sine and cosine.
    AboutX(f32, f32),
    /// Any, by its columns.
    Any([[f32; 3]; 3]),
}

/// A prepared joint.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Step {
    /// From the joint before [m].
    pub translation: [f32; 3],
    pub bend: Bend,
    pub slides: bool,
    pub variable: usize,
    pub multiplier: f32,
    pub offset: f32,
    /// Whether an earlier joint has the same variable: their columns add up.
    pub shares: bool,
}

/// The joints from the root to a link.
#[derive(Debug, Clone, PartialEq)]
pub struct Chain {
    /// Frame of the first joint in the root: columns, then the origin [m].
    pub(crate) root: [[f32; 3]; 4],
    pub(crate) steps: Vec<Step>,
    /// Variables that move the link, each once.
    pub(crate) variables: Vec<usize>,
    /// The link's origin in the frame of the last joint [m].
    pub(crate) link: [f32; 3],
    /// The link in the frame of the last joint.
    offset: Frame,
}

/// A rotation smaller than this is none.
const SAME: f64 = 1e-9;

impl Chain {
    /// Prepares the joints from the root to a link; `link` is its frame in that of the last joint. `None` without
    /// joints.
    pub fn new(joints: &[Joint], link: &Frame) -> Option<Self> {
        let root = narrow(&joints.first()?.origin);
        let (mut steps, mut variables): (Vec<Step>, Vec<usize>) = (Vec::new(), Vec::new());
        // The rotation about the axis of the latest joint that is passed on to the next.
        let mut passed = Frame::about_z(0.0);
        for joint in joints {
            let shares = variables.contains(&joint.variable);
            if !shares {
                variables.push(joint.variable);
            }
            let origin = passed.times(&joint.origin);
            let (a, alpha, b) = angles(&origin.rotation);
            let (translation, bend) = match steps.last_mut() {
                None => ([0.0; 3], Bend::Straight),
                Some(before) if before.slides => {
                    (origin.translation, Bend::Any(origin.times(&Frame::about_z(-b)).rotation.map(single)))
                }
                Some(before) => {
                    before.offset += a as f32;
                    (Frame::about_z(-a).turn(origin.translation), about_x(alpha))
                }
            };
            passed = Frame::about_z(if steps.is_empty() { 0.0 } else { b });
            steps.push(Step {
                translation: single(translation),
                bend,
                slides: joint.slides,
                variable: joint.variable,
                multiplier: joint.multiplier as f32,
                offset: joint.offset as f32,
                shares,
            });
        }
        let offset = passed.times(link);
        Some(Self { root, steps, variables, link: single(offset.translation), offset })
    }

    /// Returns the variables of a configuration that move the link.
    pub fn variables(&self) -> &[usize] {
        &self.variables
    }

    /// Returns the number of joints.
    pub fn joints(&self) -> usize {
        self.steps.len()
    }

    /// Converts a pose of the link in the root to what a solver compares with: columns of the rotation of the last
    /// joint, and the position of the link [m].
    pub(crate) fn target(&self, pose: &Frame) -> [[f32; 3]; 4] {
        let o = &self.offset.rotation;
        // R · offsetᵀ: its columns are those of the pose, combined by the rows of the offset.
        let column = |i: usize| pose.turn(std::array::from_fn(|k| o[k][i]));
        [single(column(0)), single(column(1)), single(column(2)), single(pose.translation)]
    }
}

fn single(v: [f64; 3]) -> [f32; 3] {
    v.map(|x| x as f32)
}

fn narrow(frame: &Frame) -> [[f32; 3]; 4] {
    let [x, y, z] = frame.rotation.map(single);
    [x, y, z, single(frame.translation)]
}

/// Returns the a, α, b of Rz(a) · Rx(α) · Rz(b), with 0 ≤ α ≤ π.
fn angles(r: &[[f64; 3]; 3]) -> (f64, f64, f64) {
    let [x, y, z] = r;
    let sine = z[0].hypot(z[1]);
    if sine < SAME {
        // One rotation about z; or a half turn about x, and then one about z.
        let up = z[2] > 0.0;
        let b = (if up { x[1] } else { -x[1] }).atan2(x[0]);
        return (0.0, if up { 0.0 } else { std::f64::consts::PI }, b);
    }
    (z[0].atan2(-z[1]), sine.atan2(z[2]), x[2].atan2(y[2]))
}

fn about_x(alpha: f64) -> Bend {
    let (s, c) = alpha.sin_cos();
    match (s, c) {
        _ if s.abs() < SAME && c > 0.0 => Bend::Straight,
        _ if c.abs() < SAME && s > 0.0 => Bend::Quarter,
        _ if c.abs() < SAME => Bend::QuarterBack,
        _ => Bend::AboutX(s as f32, c as f32),
    }
}
