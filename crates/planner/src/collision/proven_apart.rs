//! Proves pairs of links of one robot apart at every position of the joints between them, once, so that no request
//! checks them. For pairs that stay close: those are where proofs of motions need most checks.
//!
//! The joint next to each of the two links may turn all the way round: it only turns what that link sweeps, a solid of
//! revolution. With two joints in between, the axes of both keep their places, and one comparison decides. With three,
//! the range of the middle one is halved until what it moves is less than the distance.

use std::f64::consts::TAU;

use glamx::DAffine3;

use dimos_robot::kinematics::Kinematics;

use super::revolved::Revolved;
use super::scene::unchecked;
use super::shape::{Core, Solid};
use super::world::Robot;

/// A pair of links that is proven apart.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProvenApart {
    /// Indices of the links in the model.
    pub links: [usize; 2],
    /// They keep at least this distance [m].
    pub distance: f64,
}

/// Distances that are tried, the largest first [m].
const TRIED: [f64; 12] = [0.05, 0.02, 0.01, 5e-3, 3e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4, 5e-5, 2e-5];
/// Most comparisons of disks for one pair: a tenth of a second.
const BUDGET: usize = 60_000;
/// Addition to the limits of the middle joint on both sides [rad]: an arm may rest slightly outside.
const OUTSIDE: f64 = 0.05;

/// Two links of a robot, and how they move relative to each other.
#[derive(Debug, Clone)]
pub struct LinkMotion {
    /// Indices of the links in the model.
    pub links: [usize; 2],
    /// Their solids, each about the axis of the joint next to its link: in a frame whose z is that axis.
    pub solids: [Vec<Solid>; 2],
    /// The joint between those two.
    pub middle: Middle,
}

/// How the axes next to two links move relative to each other.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Middle {
    /// Not at all: the pose of the second in the first.
    Fixed(DAffine3),
    /// By a joint that turns about its z axis.
    Turns {
        /// Its frame at zero, in that of the first axis.
        joint: DAffine3,
        /// The frame of the second axis, in that of the joint.
        second: DAffine3,
        /// Its range [rad].
        range: [f64; 2],
    },
}

/// Returns the pairs of links of a robot that may be proven apart: those that are checked, of which at least one is
/// described by a mesh, with two or three joints in between that turn. `planned`: the joints whose limits hold, by the
/// model's names.
pub fn candidates(robot: &Robot, planned: &[String]) -> Vec<LinkMotion> {
    let Ok(kinematics) = Kinematics::whole(&robot.model) else { return Vec::new() };
    let has_mesh = |link: usize| robot.solids[link].iter().any(|s| matches!(s.core, Core::Hull(_) | Core::Mesh(_)));
    let links: Vec<usize> = (0..robot.solids.len()).filter(|link| !robot.solids[*link].is_empty()).collect();
    let mut found = Vec::new();
    for (number, b) in links.iter().enumerate() {
        for a in links.iter().take(number) {
            if (has_mesh(*a) || has_mesh(*b)) && unchecked(robot, *a, *b).is_none() {
                found.extend(motion(robot, &kinematics, planned, [*a, *b]));
            }
        }
    }
    found
}

/// Returns the joints between two bodies, from the one to the other: the body that each of them moves.
fn between(kinematics: &Kinematics, one: usize, other: usize) -> Vec<usize> {
    let (up, down): (Vec<usize>, Vec<usize>) =
        (kinematics.ancestors(one).collect(), kinematics.ancestors(other).collect());
    let own = up.iter().copied().filter(|body| !down.contains(body));
    own.chain(down.iter().rev().copied().filter(|body| !up.contains(body))).collect()
}

fn motion(robot: &Robot, kinematics: &Kinematics, planned: &[String], links: [usize; 2]) -> Option<LinkMotion> {
    let [one, other] = links.map(|link| kinematics.body_of(link));
    let joints = between(kinematics, one, other);
    let turns = |body: &usize| kinematics.joint(*body).is_some_and(|(_, joint)| !joint.slides);
    let (first, last) = (*joints.first()?, *joints.last()?);
    if !(2..=3).contains(&joints.len()) || !joints.iter().all(turns) {
        return None;
    }
    let mut frames = kinematics.frames();
    let mut q = vec![0.0; kinematics.dof()];
    kinematics.forward(&q, &mut frames);
    // The axis of a joint is that of the body which it moves, wherever that is.
    let about = |link: usize, body: usize, axis: usize| -> Vec<Solid> {
        let place = frames[axis].inverse() * frames[body] * kinematics.offset_of(link);
        robot.solids[link].iter().map(|solid| solid.clone().at(place * solid.frame)).collect()
    };
    let solids = [about(links[0], one, first), about(links[1], other, last)];
    let middle = match joints.get(1).filter(|_| joints.len() == 3) {
        None => Middle::Fixed(frames[first].inverse() * frames[last]),
        Some(&body) => {
            let (_, joint) = kinematics.joint(body)?;
            let position = |q: f64| joint.multiplier * q + joint.offset;
            let known = planned.contains(kinematics.names().get(joint.variable)?);
            let range = match kinematics.limits().get(joint.variable).filter(|_| known) {
                Some(limits) => {
                    let [a, b] = [limits.lower, limits.upper].map(position);
                    [a.min(b) - OUTSIDE, a.max(b) + OUTSIDE]
                }
                None => [f64::NEG_INFINITY, f64::INFINITY],
            };
            let range = if range[1] - range[0] < TAU { range } else { [-0.5 * TAU, 0.5 * TAU] };
            // Where its own position is zero.
            q[joint.variable] = if joint.multiplier == 0.0 { 0.0 } else { -joint.offset / joint.multiplier };
            kinematics.forward(&q, &mut frames);
            middle_of(&frames, (first, last), (body, kinematics.ancestors(other).any(|b| b == body)), range)
        }
    };
    Some(LinkMotion { links, solids, middle })
}

/// Returns how a middle joint moves the last axis relative to the first one. `frames` are those with it at zero;
/// `carries_last`: it does, otherwise it carries the first.
fn middle_of(
    frames: &[DAffine3],
    (first, last): (usize, usize),
    (body, carries_last): (usize, bool),
    [low, high]: [f64; 2],
) -> Middle {
    let joint = frames[first].inverse() * frames[body];
    let second = frames[body].inverse() * frames[last];
    // A joint that carries the first turns the last the other way round, as it is seen from there.
    Middle::Turns { joint, second, range: if carries_last { [low, high] } else { [-high, -low] } }
}

impl LinkMotion {
    /// Returns a distance that the pair keeps at every position of the joints, `None` if none is proven, or if it does
    /// not stay close [m]. The result depends on nothing else: neither on time nor on the machine.
    pub fn prove(&self) -> Option<f64> {
        let one = Revolved::new(&self.solids[0], &DAffine3::IDENTITY)?;
        let other = Revolved::new(&self.solids[1], &DAffine3::IDENTITY)?;
        let least = TRIED[TRIED.len() - 1];
        let keeps = |reach: f64, mut budget: usize| self.middle.is_apart(&one, &other, reach, &mut budget);
        // Most pairs touch somewhere: then nothing else is tried.
        if !keeps(least, BUDGET) {
            return None;
        }
        TRIED.into_iter().find(|tried| *tried == least || keeps(*tried, BUDGET / TRIED.len()))
    }
}

impl Middle {
    /// Returns whether two solids of revolution keep a distance.
    fn is_apart(&self, one: &Revolved, other: &Revolved, reach: f64, budget: &mut usize) -> bool {
        match self {
            Self::Fixed(second) => one.is_apart(&DAffine3::IDENTITY, other, second, reach, budget),
            Self::Turns { joint, second, range } => {
                // Either of them may be the one that moves: the one that moves less.
                let lever = |at: &DAffine3, ball: (f64, f64)| {
                    let middle = at.transform_point3(glamx::DVec3::Z * ball.0);
                    middle.x.hypot(middle.y) + ball.1
                };
                let lever = lever(second, other.ball()).min(lever(&joint.inverse(), one.ball()));
                let mut open = vec![*range];
                while let Some([low, high]) = open.pop() {
                    let middle = 0.5 * (low + high);
                    let moved = lever * 0.5 * (high - low);
                    let at = *joint * DAffine3::from_rotation_z(middle) * *second;
                    if one.is_apart(&DAffine3::IDENTITY, other, &at, reach + moved, budget) {
                        continue;
                    }
                    let touches = !one.is_apart(&DAffine3::IDENTITY, other, &at, reach, budget);
                    if touches || *budget == 0 {
                        return false;
                    }
                    open.extend([[low, middle], [middle, high]]);
                }
                true
            }
        }
    }
}
