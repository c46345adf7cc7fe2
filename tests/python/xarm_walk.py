"""Every public method of the vendor's client, against our emulator or `dimos proxy xarm`: `xarm_walk.py WHAT HOST`.

A call that returns 0 must have changed what it names, judged from the true state, or be a query with right values.
"""

import inspect
import math
import os
import time
from functools import partial

from xarm.wrapper import XArmAPI
from xarm_calls import (
    ARGUMENTS,
    CHANGES,
    EMULATED,
    HOST,
    LOCAL,
    POSE,
    QUERIES,
    REFUSED,
    STUDIO,
    WITHOUT_CODE,
    at,
    joints,
    near,
    settle,
    truth,
)

# What must work, so that refusing everything is no way out.
WORKS = [
    "set_servo_angle",
    "set_servo_angle_j",
    "vc_set_joint_velocity",
    "set_state",
    "motion_enable",
    "set_mode",
    "clean_error",
    "get_servo_angle",
    "get_joint_states",
    "get_position",
    "get_state",
    "set_gripper_position",
    "get_gripper_position",
]
WORKS += [
    "set_servo_angle relative",
    "set_servo_angle all relative",
    "set_position relative",
    "set_position_aa",
    "set_pause_time",
]
WORKS_EMULATED = [
    "set_position",
    "set_position y only",
    "set_tool_position",
    "set_position_aa absolute",
    "set_position_aa tool",
    "set_servo_cartesian",
    "set_servo_cartesian_aa",
    "move_gohome",
    "set_tcp_offset",
    "set_world_offset",
    "get_inverse_kinematics",
    "get_forward_kinematics",
    "set_collision_sensitivity",
    "set_tcp_jerk",
    "only_check_type 1",
    "set_tgpio_digital",
    "open_lite6_gripper",
    "close_lite6_gripper",
    "set_vacuum_gripper",
]
# In the proxy, what would move, switch or simulate and is not on its page returns 10.
REFUSED_10 = [
    "set_position",
    "set_position y only",
    "set_tool_position",
    "set_position_aa absolute",
    "move_circle",
    "set_servo_cartesian",
    "set_servo_cartesian_aa",
    "vc_set_cartesian_velocity",
    "set_mode 5",
    "set_tcp_offset",
    "set_world_offset",
    "set_tgpio_digital",
    "set_cgpio_digital",
    "set_collision_sensitivity",
    "set_simulation_robot",
    "set_servo_detach",
]


def code_of(result):
    if isinstance(result, (tuple, list)):
        return result[0], (result[1] if len(result) == 2 else result[1:])
    return result, None


def call(arm, name, action):
    try:
        return code_of(action())
    except Exception as error:  # what the client makes of a refused answer is no success
        return f"{type(error).__name__}: {error}", None


def main():
    arm = XArmAPI(HOST)
    failures, codes = [], {}
    arm.set_gripper_enable(True)
    methods = [n for n, f in inspect.getmembers(XArmAPI, inspect.isfunction) if not n.startswith("_")]
    covered = {name.split()[0] for name in CHANGES} | set(REFUSED) | set(LOCAL) | set(STUDIO)

    def known(n):
        return n in covered or n in QUERIES or n.startswith(("get_", "register_", "release_", "is_"))

    failures += [f"{n}: not in the tables of this test" for n in methods if not known(n)]

    for name in (n for n in methods if n.startswith(("get_", "is_")) and n not in LOCAL + STUDIO):
        settle(arm)
        arguments = ARGUMENTS.get(name, ())
        if name == "get_inverse_kinematics":
            arguments = (arm.get_position()[1],)
        code, value = call(arm, name, partial(getattr(arm, name), *arguments))
        if name == "get_is_moving":
            code, value = 0, code
        codes[name] = code
        right = QUERIES.get(name, lambda a, v: False)
        if (
            code == 0
            and right is not None
            and call(arm, name, lambda right=right, value=value: bool(right(arm, value)))[0] is not True
        ):
            failures.append(f"{name} returns 0 and {value}")
    for name, arguments in REFUSED.items():
        settle(arm)
        before = truth()
        codes[name] = code = call(arm, name, partial(getattr(arm, name), *arguments))[0]
        if code == 0:
            failures.append(f"{name} returns 0 for nothing")
        if not near(truth()["joints"], before["joints"], 0.002):
            failures.append(f"{name} has moved the arm")
    for name, (action, mode, judge) in CHANGES.items():
        settle(arm, mode)
        before = {**truth(), "pose": arm.get_position()[1]}
        codes[name] = code = call(arm, name, partial(action, arm, before["pose"]))[0]
        time.sleep(0.5)
        # The load resets the box, which the client calls not ready.
        done = code == 0 or (code is None and name in WITHOUT_CODE) or (name == "set_tcp_load" and code == 9)
        if name == "set_servo_angle relative":
            judge = at(0, -23, -30, 0, 50, 0)
        if done and judge is None:
            # The run judges a jump after its reply.
            if not (name.endswith("jump") and not EMULATED and near(joints(), POSE, 0.2)):
                failures.append(f"{name} returns {code}")
        elif done and judge and not judge(arm, before):
            failures.append(f"{name} returns {code} without effect: {joints()}, {arm.get_err_warn_code()}")
        elif (
            not done and not near(joints(), [math.degrees(q) for q in before["joints"]], 0.2) and "stopped" not in name
        ):
            failures.append(f"{name} returns {code} and has moved the arm")
        if "tcp_offset" in name and EMULATED:
            arm.set_tcp_offset([0] * 6)
        if ("reduced" in name or "fen" in name) and EMULATED:
            arm.set_reduced_mode(False)
            arm.set_fence_mode(False)
        if name == "set_world_offset" and EMULATED:
            arm.set_world_offset([0] * 6)
    for name in WORKS + (WORKS_EMULATED if EMULATED else []):
        if codes.get(name) != 0:
            failures.append(f"{name} should work: {codes.get(name)}")
    for name in [] if EMULATED else REFUSED_10:
        if codes[name] != 10:
            failures.append(f"{name} returns {codes[name]}, not 10")
    print(f"{len(codes)} calls of {len(methods)} methods: {sum(code == 0 for code in codes.values())} return 0")
    raised = [f"{name}: {code}" for name, code in codes.items() if isinstance(code, str)]
    print("raised in the client: " + "; ".join(raised))
    for failure in failures:
        print("FAILED", failure)
    print("all is as it should be" if not failures else "not as it should be", flush=True)
    os._exit(bool(failures))


main()
