//! Rigid-body dynamics of selected joints: the efforts of a motion, those of gravity, and the mass matrix, without
//! allocation.
//!
//! The recursive Newton-Euler algorithm in the frames of the bodies (Luh, Walker and Paul, "On-line computational
//! scheme for mechanical manipulators", 1980; Featherstone, "Rigid Body Dynamics Algorithms", 2008, chapter 5):
//! velocities and accelerations from the root outwards, forces back. Gravity is an acceleration of the root the other
//! way. Mimic joints are folded into their leaders. Friction, rotors and springs are not part of it.

mod load;
mod stored;

pub use load::{FoundLoad, RestingEffort, find_load};

use glamx::{DAffine3, DMat3, DVec3};
use nalgebra::Isometry3;
use serde::{Deserialize, Serialize};

use crate::kinematics::{Kinematics, Motion, frame};
use crate::model::{Inertial, RobotModel};

/// Standard gravity along the root's z axis [m/s²].
pub const GRAVITY: [f64; 3] = [0.0, 0.0, -9.80665];

/// Mass and moments of a body about the origin of its frame.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Inertia {
    /// Mass [kg].
    mass: f64,
    /// Mass times centre [kg·m].
    first: DVec3,
    /// Second moments about the origin [kg·m²].
    second: DMat3,
}

impl Inertia {
    const NONE: Self = Self { mass: 0.0, first: DVec3::ZERO, second: DMat3::ZERO };

    /// Returns that of a mass [kg] at a centre [m], with its inertia about the centre [kg·m²], all in one frame.
    fn new(mass: f64, center: DVec3, about_center: DMat3) -> Self {
        let [x, y, z] = center.to_array();
        let (xx, yy, zz) = (y * y + z * z, x * x + z * z, x * x + y * y);
        let shift = DMat3::from_cols_array(&[xx, -x * y, -x * z, -x * y, yy, -y * z, -x * z, -y * z, zz]);
        Self { mass, first: center * mass, second: about_center + shift * mass }
    }

    fn plus(self, other: Self) -> Self {
        Self { mass: self.mass + other.mass, first: self.first + other.first, second: self.second + other.second }
    }
}

/// What is known of a body during a computation, in its frame.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct State {
    /// Orientation in the parent's frame, and place there [m].
    turn: DMat3,
    place: DVec3,
    /// Angular velocity [rad/s] and acceleration [rad/s²], linear acceleration of the origin [m/s²].
    omega: DVec3,
    alpha: DVec3,
    linear: DVec3,
    /// Force [N] and moment about the origin [Nm].
    force: DVec3,
    moment: DVec3,
}

/// Dynamics of the joints of a [`Kinematics`]; reuses its buffers.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(try_from = "stored::Stored", into = "stored::Stored")]
pub struct Dynamics {
    kinematics: Kinematics,
    inertias: Vec<Inertia>,
    states: Vec<State>,
    /// Acceleration of the root against gravity [m/s²].
    upwards: DVec3,
    /// Link, body and inertia of what an arm carries.
    load: Option<(usize, Inertia)>,
    unit: Vec<f64>,
    column: Vec<f64>,
}

impl Dynamics {
    /// Takes the masses of a model's links; `kinematics` is of the same model. Links without an `inertial` count as
    /// massless: [`massless`].
    pub fn new(model: &RobotModel, kinematics: Kinematics) -> Self {
        let mut inertias = vec![Inertia::NONE; kinematics.bodies.len()];
        for (link, (body, place)) in model.links.iter().zip(&kinematics.links) {
            if let (Some(inertial), Some(sum)) = (&link.inertial, inertias.get_mut(*body)) {
                *sum = sum.plus(moved(inertial, place));
            }
        }
        Self::of_inertias(kinematics, inertias)
    }

    fn of_inertias(kinematics: Kinematics, inertias: Vec<Inertia>) -> Self {
        let (states, dof) = (vec![State::default(); inertias.len()], kinematics.dof());
        let upwards = -DVec3::from_array(GRAVITY);
        Self { kinematics, inertias, states, upwards, load: None, unit: vec![0.0; dof], column: vec![0.0; dof] }
    }

    /// Sets gravity in the frame of the root [m/s²]; before, it is [`GRAVITY`].
    pub fn set_gravity(&mut self, gravity: [f64; 3]) {
        self.upwards = -DVec3::from_array(gravity);
    }

    /// Sets what a link carries: mass [kg], its centre [m] and its inertia about the centre [kg·m²] in the frame of the
    /// link; `None`: nothing. Returns whether there is such a link.
    pub fn set_load(&mut self, link: usize, load: Option<&Inertial>) -> bool {
        let Some((body, place)) = self.kinematics.links.get(link) else { return false };
        self.load = load.map(|load| (*body, moved(load, place)));
        true
    }

    /// Returns the number of joints.
    pub fn dof(&self) -> usize {
        self.kinematics.dof()
    }

    /// Returns the names of the joints, in the order of all values.
    pub fn names(&self) -> &[String] {
        self.kinematics.names()
    }

    /// Computes the efforts [Nm, or N for prismatic joints] with which the joints move at positions [rad or m] with
    /// these velocities and accelerations [1/s, 1/s² of that]. Missing values are 0.
    pub fn inverse(&mut self, q: &[f64], qd: &[f64], qdd: &[f64], efforts: &mut [f64]) {
        self.compute([q, qd, qdd], self.upwards, efforts);
    }

    /// Computes the efforts with which the joints hold still against gravity.
    pub fn gravity(&mut self, q: &[f64], efforts: &mut [f64]) {
        self.compute([q, &[], &[]], self.upwards, efforts);
    }

    /// Computes the mass matrix [kg·m², kg·m or kg], row after row: efforts per acceleration.
    pub fn mass_matrix(&mut self, q: &[f64], rows: &mut [f64]) {
        let dof = self.dof();
        let (mut unit, mut column) = (std::mem::take(&mut self.unit), std::mem::take(&mut self.column));
        for k in 0..dof {
            unit.iter_mut().enumerate().for_each(|(j, x)| *x = f64::from(u8::from(j == k)));
            self.compute([q, &[], &unit], DVec3::ZERO, &mut column);
            for (row, value) in rows.chunks_exact_mut(dof).zip(&column) {
                if let Some(slot) = row.get_mut(k) {
                    *slot = *value;
                }
            }
        }
        (self.unit, self.column) = (unit, column);
    }

    fn compute(&mut self, [q, qd, qdd]: [&[f64]; 3], upwards: DVec3, efforts: &mut [f64]) {
        let value = |of: &[f64], k: usize| of.get(k).copied().unwrap_or(0.0);
        efforts.fill(0.0);
        if let Some(root) = self.states.first_mut() {
            *root = State { linear: upwards, ..State::default() };
        }
        for (b, body) in self.kinematics.bodies.iter().enumerate().skip(1) {
            let Some(parent) = self.states.get(body.parent).copied() else { return };
            let (v, factor) = (body.variable, body.multiplier);
            let (at, rate, change) =
                (factor * value(q, v) + body.offset, factor * value(qd, v), factor * value(qdd, v));
            let own = match body.motion {
                Motion::Turn => {
                    let (sin, cos) = at.sin_cos();
                    let [x, y, z] =
                        [body.origin.matrix3.x_axis, body.origin.matrix3.y_axis, body.origin.matrix3.z_axis];
                    let turn = DMat3::from_cols(x * cos + y * sin, y * cos - x * sin, z);
                    State { turn, place: body.origin.translation, ..State::default() }
                }
                Motion::Slide => {
                    let place = body.origin.translation + body.origin.matrix3.z_axis * at;
                    State { turn: body.origin.matrix3, place, ..State::default() }
                }
            };
            let inward = own.turn.transpose();
            let omega = inward * parent.omega;
            let linear =
                parent.linear + parent.alpha.cross(own.place) + parent.omega.cross(parent.omega.cross(own.place));
            let (mut alpha, mut linear) = (inward * parent.alpha, inward * linear);
            let axis = DVec3::Z;
            let mut turning = omega;
            match body.motion {
                Motion::Turn => {
                    turning += axis * rate;
                    alpha += omega.cross(axis * rate) + axis * change;
                }
                Motion::Slide => linear += 2.0 * omega.cross(axis * rate) + axis * change,
            }
            let mut inertia = self.inertias.get(b).copied().unwrap_or(Inertia::NONE);
            if let Some((_, load)) = self.load.filter(|(carrier, _)| *carrier == b) {
                inertia = inertia.plus(load);
            }
            let Inertia { mass, first, second } = inertia;
            let force = linear * mass + alpha.cross(first) + turning.cross(turning.cross(first));
            let moment = second * alpha + turning.cross(second * turning) + first.cross(linear);
            if let Some(state) = self.states.get_mut(b) {
                *state = State { omega: turning, alpha, linear, force, moment, ..own };
            }
        }
        for (b, body) in self.kinematics.bodies.iter().enumerate().skip(1).rev() {
            let Some(own) = self.states.get(b).copied() else { return };
            let along = if body.motion == Motion::Turn { own.moment.z } else { own.force.z };
            if let Some(effort) = efforts.get_mut(body.variable) {
                *effort += body.multiplier * along;
            }
            let force = own.turn * own.force;
            if let Some(parent) = self.states.get_mut(body.parent) {
                parent.force += force;
                parent.moment += own.turn * own.moment + own.place.cross(force);
            }
        }
    }
}

/// What was computed last is no part of it.
impl PartialEq for Dynamics {
    fn eq(&self, other: &Self) -> bool {
        let of = |it: &Self| (it.upwards, it.load);
        self.kinematics == other.kinematics && self.inertias == other.inertias && of(self) == of(other)
    }
}

/// Returns an inertia that is given in a link's frame in that of its body.
fn moved(inertial: &Inertial, place: &DAffine3) -> Inertia {
    let at: DAffine3 = *place * frame(&inertial.origin);
    let about_center = DMat3::from_cols_slice(inertial.inertia.as_slice());
    Inertia::new(inertial.mass, at.translation, at.matrix3 * about_center * at.matrix3.transpose())
}

/// Returns a point mass [kg] at a place [m].
pub fn point_mass(mass: f64, center: [f64; 3]) -> Inertial {
    let origin = Isometry3::translation(center[0], center[1], center[2]);
    Inertial { origin, mass, inertia: nalgebra::Matrix3::zeros() }
}

/// Returns the links that joints move and that have no mass, but a shape: their weight is not known.
pub fn massless(model: &RobotModel) -> Vec<&str> {
    let moves = |mut link: usize| {
        while let Some(joint) = link.checked_sub(1).and_then(|joint| model.joints.get(joint)) {
            if joint.is_movable() {
                return true;
            }
            link = joint.parent;
        }
        false
    };
    let is_there = |link: &crate::model::Link| !link.visuals.is_empty() || !link.collisions.is_empty();
    let weightless = |link: &crate::model::Link| link.inertial.as_ref().is_none_or(|inertial| inertial.mass <= 0.0);
    let links = model.links.iter().enumerate().filter(|(l, link)| is_there(link) && weightless(link) && moves(*l));
    links.map(|(_, link)| link.name.as_str()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::urdf::from_text;

    /// A pendulum of two rods with a slide at the end.
    const ARM: &str = "<robot name='r'><link name='base'/>\
        <joint name='a' type='continuous'><parent link='base'/><child link='one'/><axis xyz='0 1 0'/></joint>\
        <link name='one'><inertial><origin xyz='0 0 0.5'/><mass value='2'/>\
        <inertia ixx='0.1' ixy='0' ixz='0' iyy='0.1' iyz='0' izz='0.01'/></inertial></link>\
        <joint name='b' type='prismatic'><origin xyz='0 0 1'/><parent link='one'/><child link='two'/>\
        <axis xyz='0 0 1'/><limit lower='0' upper='1' velocity='1' effort='1'/></joint>\
        <link name='two'><inertial><mass value='3'/>\
        <inertia ixx='0' ixy='0' ixz='0' iyy='0' iyz='0' izz='0'/></inertial></link></robot>";

    fn arm() -> Dynamics {
        let model = from_text("r", ARM).unwrap();
        let kinematics = Kinematics::whole(&model).unwrap();
        Dynamics::new(&model, kinematics)
    }

    #[test]
    fn a_pendulum_has_the_efforts_of_the_textbook() {
        let (mut arm, g, angle) = (arm(), 9.80665, 0.7_f64);
        let mut efforts = [0.0; 2];
        arm.gravity(&[angle, 0.2], &mut efforts);
        assert!((efforts[0] + g * angle.sin() * (2.0 * 0.5 + 3.0 * 1.2)).abs() < 1e-12, "{efforts:?}");
        assert!((efforts[1] - 3.0 * g * angle.cos()).abs() < 1e-12);
        // Centrifugal and Coriolis forces of the slide.
        arm.set_gravity([0.0; 3]);
        arm.inverse(&[angle, 0.2], &[2.0, 0.5], &[], &mut efforts);
        assert!(
            (efforts[1] + 3.0 * 1.2 * 4.0).abs() < 1e-12 && (efforts[0] - 2.0 * 3.0 * 1.2 * 2.0 * 0.5).abs() < 1e-12
        );
        let mut mass = [0.0; 4];
        arm.mass_matrix(&[angle, 0.2], &mut mass);
        let expected = [0.1 + 2.0 * 0.25 + 3.0 * 1.44, 0.0, 0.0, 3.0];
        assert!(mass.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{mass:?}");
    }

    #[test]
    fn it_comes_out_of_a_log_as_it_went_in() {
        let mut arm = arm();
        arm.set_gravity([0.0, -9.8, 0.1]);
        arm.set_load(2, Some(&point_mass(1.5, [0.0, 0.01, 0.1])));
        let text = serde_json::to_string(&arm).unwrap();
        let mut read: Dynamics = serde_json::from_str(&text).unwrap();
        assert_eq!(read, arm);
        let (mut before, mut after) = ([0.0; 2], [0.0; 2]);
        arm.inverse(&[0.7, 0.2], &[2.0, 0.5], &[0.3, -1.0], &mut before);
        read.inverse(&[0.7, 0.2], &[2.0, 0.5], &[0.3, -1.0], &mut after);
        assert_eq!(after, before);
        let short = text.replacen("\"inertias\":[[", "\"inertias\":[[0,0,0,0,0,0,0,0,0,0,0,0,0],[", 1);
        assert!(serde_json::from_str::<Dynamics>(&short).is_err(), "one inertia too many");
    }

    #[test]
    fn a_load_adds_its_weight_and_links_without_a_mass_are_named() {
        let mut arm = arm();
        let (mut bare, mut loaded) = ([0.0; 2], [0.0; 2]);
        arm.gravity(&[0.5, 0.0], &mut bare);
        assert!(arm.set_load(2, Some(&point_mass(1.0, [0.0, 0.0, 0.1]))));
        arm.gravity(&[0.5, 0.0], &mut loaded);
        assert!((loaded[0] - bare[0] + 9.80665 * 0.5_f64.sin() * 1.1).abs() < 1e-12);
        assert!(!arm.set_load(9, None));
        let shape = "<collision><geometry><sphere radius='0.1'/></geometry></collision></link></robot>";
        let text = ARM.replace("<mass value='3'/>", "<mass value='0'/>");
        assert_eq!(massless(&from_text("r", &text).unwrap()), Vec::<&str>::new(), "nothing is known to be there");
        assert_eq!(massless(&from_text("r", &text.replace("</link></robot>", shape)).unwrap()), ["two"]);
    }
}
