//! What is only read: the tool's speed, seams and turns, torques at rest.

use std::f64::consts::{PI, TAU};

use super::{End, Tour, skipped};
use crate::check::Checked;
use dimos_core::arm::Topology;

/// Acceleration of gravity [m/s²].
const GRAVITY: f64 = 9.81;
/// A tool closer to an axis counts as this far from it [m].
const NEAREST: f64 = 0.05;

impl Tour<'_> {
    /// Prints the vendor's limit of the tool's speed, and the speed of joint 1 that meets it: it has the longest
    /// lever of an outstretched arm.
    pub(super) fn tool_speed(&mut self) -> Result<String, End> {
        let Some(limit) = self.checked().and_then(|checked| checked.tool.velocity) else {
            return skipped(format!("{} states no limit of the tool's speed that the adapter knows", self.row.name));
        };
        self.read()?;
        let pose = self.adapter.cartesian().map_or(Ok(None), |it| it.read_cartesian_position())?;
        let Some(pose) = pose else { return skipped("the arm reports no pose of its tool") };
        let [x, y, _] = pose.tcp.xyz;
        let beside = x.hypot(y);
        let line = format!("hardware.arm.limits.tcp_velocity: {limit:.2}");
        self.figure("limit of the tool's speed", limit, "m/s", Some(line));
        self.figure("distance of the tool from the axis of joint 1", beside, "m", None);
        let speed = limit / beside.max(NEAREST);
        self.figure("speed of joint 1 alone that meets it", speed, "rad/s", None);
        Ok(format!("at this pose joint 1 alone may not exceed {speed:.2} rad/s"))
    }

    /// Returns what the adapter knows of the arm without it.
    fn checked(&self) -> Option<Checked> {
        (self.row.check)(self.config).ok()
    }

    /// Says how far each joint is from its seam, or which turn it is in.
    pub(super) fn seams(&mut self) -> Result<String, End> {
        let positions = self.positions()?;
        let topology = self.checked().map(|checked| checked.topology).unwrap_or_default();
        let mut nearest = f64::INFINITY;
        for (i, position) in positions.iter().enumerate() {
            match topology.get(i).copied().unwrap_or(self.row.topology) {
                Topology::Seamed => {
                    let to_seam = PI - ((position + PI).rem_euclid(TAU) - PI).abs();
                    nearest = nearest.min(to_seam);
                    let name = format!("joint {} to the seam, without homing offset", i + 1);
                    self.figure(name, to_seam.to_degrees(), "°", None);
                }
                Topology::MultiTurn => {
                    self.figure(format!("joint {} is in turn", i + 1), (position / TAU).round(), "turns", None);
                }
                Topology::Endless => self.figure(format!("joint {} turns without end", i + 1), *position, "rad", None),
            }
        }
        Ok(match nearest.is_finite() {
            true => format!("the nearest seam is {:.0}° away", nearest.to_degrees()),
            false => "no joint has a seam; compare the turns again after a power cycle".to_owned(),
        })
    }

    /// Compares torques at rest with the load that the controller assumes.
    pub(super) fn payload(&mut self) -> Result<String, End> {
        self.prepare()?;
        self.still()?;
        let (mut sums, mut count) = (vec![0.0; self.info.dof], 0.0);
        for _ in 0..50 {
            let Some(efforts) = self.read()?.0.effort else { return skipped("the arm reports no torques") };
            sums.iter_mut().zip(efforts).for_each(|(sum, effort)| *sum += effort);
            count += 1.0;
            self.wait(std::time::Duration::from_millis(4))?;
        }
        for (i, sum) in sums.iter().enumerate() {
            self.figure(format!("torque of joint {} at rest", i + 1), sum / count, "Nm", None);
        }
        let set = self.adapter.payload().map_or(Ok(None), |payload| payload.read_payload())?;
        let Some(set) = set else {
            return Ok("the controller takes no load: compare the torques with its weight".into());
        };
        let pose = self.adapter.cartesian().map_or(Ok(None), |it| it.read_cartesian_position())?;
        self.figure(
            "load that the controller assumes",
            set.mass,
            "kg",
            Some(format!("hardware.arm.payload.mass: {:.2}", set.mass)),
        );
        let Some(pose) = pose else { return Ok(format!("the controller assumes {:.2} kg", set.mass)) };
        let [x, y, _] = pose.tcp.xyz;
        let torque = set.mass * GRAVITY * x.hypot(y);
        self.figure("torque of that load about the base, upright", torque, "Nm", None);
        Ok(format!("the controller assumes {:.2} kg, {torque:.1} Nm about the base", set.mass))
    }
}
