"""The body of an emulated arm in MuJoCo: its masses, friction, contacts, and the inner loop of its drives.

A line of JSON comes in, one goes out. The first has the scene, the others a number of steps. It ends with its input.
"""

import json
import sys

try:
    import mujoco
    import numpy as np
except ImportError as missing:
    print(missing, file=sys.stderr)
    sys.exit(3)

STEP = 0.001  # s
BANDWIDTH = 60.0  # of the position control of a drive that compensates gravity [rad/s]
DAMPING = 0.9  # of that control, relative to critical
INTEGRAL = 3.0  # of that control [1/s]
ROTOR = (0.1, 0.02)  # inertia of a rotor behind its gear, as parts of that of its joint and of the heaviest one
FRICTION = 0.02  # Coulomb friction, as a part of the highest weight of the joint
VISCOUS = 0.2  # viscous friction: inertia of the joint in this time [1/s]
POSES = 64  # in which weights and inertias are examined
FREE, DRIVEN, BRAKED, COMPLIANT = range(4)


class Body:
    def __init__(self, mjcf, joints, efforts, droop, seed, position):
        # The controller computes with the model as it is written; the body differs from that by the seed.
        self.known = mujoco.MjModel.from_xml_string(mjcf)
        self.model = mujoco.MjModel.from_xml_string(mjcf)
        for model in (self.known, self.model):
            model.opt.timestep = STEP
        ids = [self.model.joint(name).id for name in joints]
        self.q, self.v = self.model.jnt_qposadr[ids], self.model.jnt_dofadr[ids]
        self.drives = [self.model.actuator(name).id for name in joints]
        self.efforts = np.array([effort if effort > 0.0 else np.inf for effort in efforts])
        self.thought = mujoco.MjData(self.known)
        inertia, weight = self.look_around(ids)
        rotor = ROTOR[0] * inertia + ROTOR[1] * inertia.max()
        for model in (self.known, self.model):
            model.dof_armature[self.v] = rotor
        self.vary(np.random.RandomState(seed) if seed else None, inertia, weight)
        self.data = mujoco.MjData(self.model)
        self.data.qpos[self.q] = position
        mujoco.mj_forward(self.model, self.data)
        inertia = inertia + rotor
        self.compensates = droop == 0.0
        if self.compensates:
            self.stiffness = inertia * BANDWIDTH**2
            self.damping = 2.0 * DAMPING * inertia * BANDWIDTH
        else:  # without an integral part, it rests below its target
            self.stiffness = np.maximum(weight, 0.05 * weight.max()) / droop
            self.damping = 2.0 * DAMPING * np.sqrt(self.stiffness * inertia)
        self.integral, self.held = np.zeros(len(joints)), np.zeros(self.known.nv)
        self.hold, none = np.array(position, dtype=float), [0.0] * len(joints)
        self.braked, self.command = np.full(len(joints), True), None
        self.drive([BRAKED] * len(joints), none, none, none)

    def look_around(self, ids):
        """Returns the highest inertia and the highest weight of each joint."""
        random, model, data = np.random.RandomState(1), self.known, self.thought
        full = np.zeros((model.nv, model.nv))
        inertia, weight = np.zeros(len(ids)), np.zeros(len(ids))
        for _ in range(POSES):
            for joint, at in zip(ids, self.q):
                low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-np.pi, np.pi)
                data.qpos[at] = random.uniform(low, high)
            mujoco.mj_forward(model, data)
            mujoco.mj_fullM(model, full, data.qM)
            inertia = np.maximum(inertia, np.diag(full)[self.v])
            weight = np.maximum(weight, np.abs(data.qfrc_bias[self.v]))
        return np.maximum(inertia, 1e-4), np.maximum(weight, 1e-3)

    def vary(self, random, inertia, weight):
        model = self.model
        model.dof_damping[self.v] = VISCOUS * inertia
        if random is None:
            return
        # What the arm carries is what the blueprint says.
        arm = np.array([model.body(body).name != "payload" for body in range(model.nbody)])
        by = np.where(arm, random.uniform(0.9, 1.1, model.nbody), 1.0)
        model.body_mass[:] *= by
        model.body_inertia[:] *= by[:, None]
        moved = (arm & (model.body_mass > 0.0))[:, None]
        model.body_ipos[:] += random.uniform(-0.01, 0.01, (model.nbody, 3)) * moved
        joints = len(self.v)
        model.dof_damping[self.v] *= random.uniform(0.5, 1.5, joints)
        model.dof_frictionloss[self.v] = FRICTION * weight * random.uniform(0.5, 1.5, joints)
        model.dof_armature[self.v] *= random.uniform(0.7, 1.3, joints)
        mujoco.mj_setConst(model, mujoco.MjData(model))

    def weight(self):
        """What holds the arm, as its controller thinks."""
        model, data = self.known, self.thought
        data.qpos[:] = self.data.qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_rne(model, data, 0, self.held)
        return self.held[self.v]

    def drive(self, *command):
        """Takes how the joints are driven: modes, efforts, stiffness and damping of compliant ones."""
        if command == self.command:
            return
        mode, effort, stiffness, damping = (np.array(values) for values in command)
        braked, driven, compliant = mode == BRAKED, mode == DRIVEN, mode == COMPLIANT
        self.hold = np.where(braked & ~self.braked, self.data.qpos[self.q], self.hold)
        self.braked, self.driven, kinds = braked, driven, [braked, driven, compliant]
        spring = np.select(kinds, [20.0 * self.stiffness, self.stiffness, stiffness])
        damper = np.select(kinds, [10.0 * self.damping, self.damping, damping])
        self.spring, self.damper, self.added = spring, damper, np.where(driven | compliant, effort, 0.0)
        # MuJoCo's own actuators: their damping is integrated implicitly.
        limit = np.where(braked, 100.0 * np.minimum(self.efforts, 1e4), np.minimum(self.efforts, 1e6))
        self.model.actuator_biasprm[self.drives, 1] = -spring
        self.model.actuator_biasprm[self.drives, 2] = -damper
        self.model.actuator_forcerange[self.drives] = np.stack([-limit, limit], axis=1)
        self.limit, self.integral = limit, self.integral * driven
        self.thinks, self.command = self.compensates and driven.any(), command

    def advance(self, steps, mode, effort, stiffness, damping):
        """Steps through references: each has the positions of all joints, then their velocities."""
        self.drive(mode, effort, stiffness, damping)
        joints, data = len(self.q), self.data
        given = np.array(steps).reshape(-1, 2 * joints)
        targets = np.where(self.braked, self.hold, given[:, :joints])
        speeds = np.where(self.braked, 0.0, given[:, joints:])
        for target, speed in zip(targets, speeds):
            wanted = self.spring * target + self.damper * speed + self.added
            if self.thinks:
                wanted += (self.weight() + self.integral) * self.driven
                # What the drive cannot give is not summed up.
                grows = self.driven & (np.abs(data.actuator_force[self.drives]) < self.limit)
                self.integral += INTEGRAL * STEP * self.spring * (target - data.qpos[self.q]) * grows
            data.ctrl[self.drives] = wanted
            mujoco.mj_step(self.model, data)
        shown = np.where(self.braked, 0.0, data.actuator_force[self.drives])
        q, v = data.qpos[self.q].tolist(), data.qvel[self.v].tolist()
        return {"q": q, "v": v, "effort": shown.tolist(), "contacts": self.contacts() if data.ncon else []}

    def contacts(self):
        found = {}
        for index in range(self.data.ncon):
            contact, force = self.data.contact[index], np.zeros(6)
            mujoco.mj_contactForce(self.model, self.data, index, force)
            bodies = [self.model.body(self.model.geom_bodyid[geom]).name for geom in (contact.geom1, contact.geom2)]
            pair = tuple(bodies if self.model.geom_contype[contact.geom1] == 1 else reversed(bodies))
            found[pair] = found.get(pair, 0.0) + float(np.linalg.norm(force[:3]))
        return [[*pair, force] for pair, force in sorted(found.items())]


def main():
    body = Body(**json.loads(sys.stdin.readline()))
    print(json.dumps({"mujoco": mujoco.__version__}), flush=True)
    for line in sys.stdin:
        print(json.dumps(body.advance(**json.loads(line))), flush=True)


if __name__ == "__main__":
    main()
