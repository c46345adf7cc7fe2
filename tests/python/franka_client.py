"""The vendor's clients on an emulated controller: franka_client.py fr3|fer ADDRESS. With `fr3` pylibfranka, with `fer`
libfranka 0.9 as panda-python has it."""

import sys
import time
from typing import Any

DURATION = 1.0


def check(what, holds):
    if not holds:
        sys.exit(f"wrong: {what}")


def ease(t):
    """A smooth way from 0 to 1, and its slope."""
    return t * t * t * (10 - 15 * t + 6 * t * t), 30 * t * t * (1 - t) ** 2


class Fr3:
    def __init__(self, address):
        import pylibfranka

        self.it = pylibfranka
        self.robot = pylibfranka.Robot(address, pylibfranka.RealtimeConfig.kIgnore)

    def read(self):
        return self.robot.read_once()

    def recover(self):
        self.robot.automatic_error_recovery()

    def set_behavior(self):
        self.robot.set_collision_behavior([20.0] * 7, [20.0] * 7, [20.0] * 6, [20.0] * 6)
        self.robot.set_joint_impedance([3000.0] * 7)
        self.robot.set_load(0.5, [0, 0, 0.03], [0.01, 0, 0, 0, 0.01, 0, 0, 0, 0.01])
        self.robot.set_EE([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0.1, 1])

    def move(self, velocity, of):
        """`of` gets the time [s] and the first desired positions, and returns values and whether they are the last."""
        mode = self.it.ControllerMode.JointImpedance
        start = self.robot.start_joint_velocity_control if velocity else self.robot.start_joint_position_control
        kind = self.it.JointVelocities if velocity else self.it.JointPositions
        control = start(mode)
        state, _ = control.readOnce()
        q, t = list(state.q_d), 0.0
        while True:
            values, last = of(t, q)
            command = kind(values)
            command.motion_finished = last
            control.writeOnce(command)
            if last:
                return
            state, step = control.readOnce()
            t += step.to_sec()

    def gripper(self, address):
        return self.it.Gripper(address)


class Fer:
    def __init__(self, address):
        from panda_py import libfranka

        self.it = libfranka
        self.robot = libfranka.Robot(address, libfranka.RealtimeConfig.kIgnore)

    def read(self):
        return self.robot.read_once()

    def recover(self):
        self.robot.automatic_error_recovery()

    def set_behavior(self):
        self.robot.set_collision_behavior([20.0] * 7, [20.0] * 7, [20.0] * 6, [20.0] * 6)
        self.robot.set_joint_impedance([3000.0] * 7)
        self.robot.set_load(0.5, [0, 0, 0.03], [0.01, 0, 0, 0, 0.01, 0, 0, 0, 0.01])
        self.robot.set_ee([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0.1, 1])

    def move(self, velocity, of):
        kind = self.it.JointVelocities if velocity else self.it.JointPositions
        control = self.robot.control_joint_velocity if velocity else self.robot.control_joint_position
        seen: dict[str, Any] = {}

        def callback(state, step):
            seen.setdefault("q", list(state.q_d))
            seen["t"] = seen.get("t", 0.0) + step.to_sec()
            values, last = of(seen["t"], seen["q"])
            command = kind(values)
            command.motion_finished = last
            return command

        control(callback, limit_rate=True, cutoff_frequency=100.0)

    def gripper(self, address):
        return self.it.Gripper(address)


def soon(arm, holds):
    """Whether it holds in one of the next states: the newest may be older than the reply to a request."""
    return any(holds(arm.read()) for _ in range(20))


def main(model, address):
    arm = (Fr3 if model == "fr3" else Fer)(address)
    first = arm.read()
    start = list(first.q)
    check(f"pose {start}", all(abs(a - b) < 1e-6 for a, b in zip(start, [0.2, -0.6, 0.1, -1.9, -0.15, 1.7, 0.8])))
    check("mode", str(first.robot_mode).endswith("Idle"))
    check("no error", not first.current_errors)
    arm.set_behavior()
    check("load", soon(arm, lambda state: abs(state.m_load - 0.5) < 1e-6))

    sign = [1, -1, 1, 1, -1, 1, -1]

    def positions(t, q):
        part = ease(min(t / DURATION, 1.0))[0]
        return [a + 0.15 * s * part for a, s in zip(q, sign)], t >= DURATION + 0.1

    arm.move(False, positions)
    time.sleep(0.2)
    there = arm.read()
    check(f"moved {list(there.q)}", all(abs(a + 0.15 * s - b) < 2e-3 for a, s, b in zip(start, sign, there.q)))
    check("idle again", str(there.robot_mode).endswith("Idle"))

    def velocities(t, q):
        slope = 0.0 if t >= DURATION else -0.15 * ease(t / DURATION)[1] / DURATION
        return [s * slope for s in sign], t >= DURATION + 0.1

    arm.move(True, velocities)
    time.sleep(0.2)
    back = arm.read()
    check(f"moved back {list(back.q)}", all(abs(a - b) < 0.01 for a, b in zip(start, back.q)))

    # A jump is an error by its name, and ends with a recovery.
    try:
        arm.move(False, lambda t, q: ([q[0] + 0.1, *q[1:]], t > 0.5))
        # Its own limits made it slow: no error.
        check("a jump is refused", model == "fer")
    except Exception as error:
        check(f"the jump is named in {error}", "start_pose_invalid" in str(error) or "discontinuity" in str(error))
    if model == "fr3":
        check("reflex", soon(arm, lambda state: str(state.robot_mode).endswith("Reflex")))
        check("its name", arm.read().current_errors.joint_position_motion_generator_start_pose_invalid)
    arm.recover()
    check("recovered", soon(arm, lambda state: not state.current_errors and str(state.robot_mode).endswith("Idle")))
    arm.move(False, lambda t, q: (q, t > 0.1))
    arm.robot.stop()

    hand = arm.gripper(address)
    check("hand", hand.homing() and abs(hand.read_once().width - 0.08) < 1e-3)
    check("hand moves", hand.move(0.05, 0.1) and abs(hand.read_once().width - 0.05) < 1e-3)
    check("nothing to grasp", hand.grasp(0.02, 0.1, 20.0) in (True, False))
    print("all is as it says")


main(*sys.argv[1:])
