"""The vendor's own client at `dimos proxy xarm`: `xarm_proxy.py SCENARIO HOST`.

A scenario that the test has to act in prints a line, and continues when it reads one.
"""

import math
import sys
import time

from xarm.wrapper import XArmAPI


def check(holds, what):
    if not holds:
        raise AssertionError(what)


def ok(code, what):
    check(code == 0, f"{what} returns {code}")


def until(what, holds, seconds=10):
    end = time.monotonic() + seconds
    while not holds():
        check(time.monotonic() < end, f"not within {seconds} s: {what}")
        time.sleep(0.02)


def near(a, b, limit=1e-3):
    return all(abs(x - y) < limit for x, y in zip(a, b))


def meet(what):
    print(what, flush=True)
    sys.stdin.readline()


def connect(host, **more):
    arm = XArmAPI(host, is_radian=True, **more)
    check(arm.connected, "connected")
    return arm


def enable(arm, mode):
    ok(arm.clean_error(), "clean_error")
    ok(arm.motion_enable(True), "motion_enable")
    ok(arm.set_mode(mode), "set_mode")
    ok(arm.set_state(0), "set_state")
    until(f"mode {mode}", lambda: arm.mode == mode and arm.state in (1, 2) and arm.error_code == 0)


def angles(arm):
    code, values = arm.get_servo_angle()
    ok(code, "get_servo_angle")
    return values[: arm.axis]


def velocities(arm):
    return arm.get_joint_states()[1][1]


def session(host):
    arm = connect(host)
    check(arm.version_number == (2, 5, 1) and arm.axis == 6, f"{arm.version_number}, {arm.axis} axes")
    ok(arm.get_state()[0], "get_state")
    code, pose = arm.get_position()
    check(code == 0 and 200 < math.hypot(pose[0], pose[1]) < 700, f"get_position: {code}, {pose}")
    start = angles(arm)

    # Moves: the wait ends when the arm is there; the asked speed is kept.
    enable(arm, 0)
    check(near(angles(arm), start), "enabling moves nothing")
    goal = [angle + 0.2 for angle in start]
    began = time.monotonic()
    ok(arm.set_servo_angle(angle=goal, speed=0.1, mvacc=2, wait=True), "set_servo_angle")
    took = time.monotonic() - began
    check(2.0 < took < 4.0, f"0.2 rad at 0.1 rad/s took {took:.2f} s")
    check(near(angles(arm), goal), f"it is at {angles(arm)}")
    for step in (0.1, 0.2, 0.3):
        ok(arm.set_servo_angle(servo_id=1, angle=goal[0] + step, speed=1.5, wait=False), "a queued move")
    check(arm.get_cmdnum()[1] >= 1, "moves wait in the queue")
    until("the last of the queue", lambda: near(angles(arm), [goal[0] + 0.3, *goal[1:]]))
    ok(arm.set_servo_angle(angle=start, speed=0.3), "a move to pause")
    time.sleep(0.3)
    ok(arm.set_state(3), "pause")
    until("rest", lambda: max(map(abs, velocities(arm))) < 1e-3)
    check(not near(angles(arm), start, 0.05), "it has paused on the way")
    ok(arm.set_state(0), "resume")
    until("the end of the paused move", lambda: near(angles(arm), start))

    # A stream of setpoints.
    enable(arm, 1)
    for i in range(200):
        target = list(start)
        target[3] += 0.2 * (1 - math.cos(2 * math.pi * i / 200)) / 2
        ok(arm.set_servo_angle_j(target), "set_servo_angle_j")
        if i == 100:
            check(angles(arm)[3] > start[3] + 0.12, f"it follows: {angles(arm)[3] - start[3]}")
        time.sleep(0.008)
    ok(arm.set_servo_angle_j(start), "set_servo_angle_j")
    until("the last setpoint", lambda: near(angles(arm), start, 2e-3))

    # A velocity lasts until the next one, or for its time.
    ok(arm.set_mode(0), "set_mode")
    enable(arm, 4)
    ok(arm.vc_set_joint_velocity([0, 0, 0, 0, 0, 0.2]), "vc_set_joint_velocity")
    time.sleep(0.8)
    check(abs(velocities(arm)[5] - 0.2) < 0.02, f"rad/s: {velocities(arm)}")
    ok(arm.vc_set_joint_velocity([0] * 6), "vc_set_joint_velocity")
    until("rest", lambda: abs(velocities(arm)[5]) < 1e-3)
    ok(arm.vc_set_joint_velocity([0, 0, 0, 0, 0, -0.2], duration=0.4), "vc_set_joint_velocity")
    time.sleep(0.25)
    check(abs(velocities(arm)[5] + 0.2) < 0.02, f"rad/s: {velocities(arm)}")
    until("the end of the velocity", lambda: abs(velocities(arm)[5]) < 1e-3, 1)

    # What it cannot do is refused.
    check(arm.set_mode(5) != 0, "Cartesian velocity")
    check(arm.get_forward_kinematics(start)[0] != 0, "forward kinematics")
    check(arm.set_collision_sensitivity(5) != 0, "a setting of the box")
    check(arm.error_code == 0, "a refused setting is no error")
    ok(arm.set_gripper_enable(True), "set_gripper_enable")
    ok(arm.set_gripper_mode(0), "set_gripper_mode")
    ok(arm.set_gripper_position(400, wait=True), "set_gripper_position")
    code, pulses = arm.get_gripper_position()
    check(code == 0 and abs(pulses - 400) <= 5, f"get_gripper_position: {code}, {pulses}")

    # The client's stop is the run's.
    ok(arm.set_mode(0), "set_mode")
    enable(arm, 0)
    ok(arm.set_servo_angle(angle=goal, speed=0.2), "a move to stop")
    time.sleep(0.3)
    arm.emergency_stop()
    check(arm.state == 4, f"state {arm.state}")
    meet("stopped")
    check(arm.set_state(0) == 10 and arm.get_state()[1] == 4, "not ready before a reset")
    check(arm.motion_enable(True) == 10, "not enabled before a reset")
    check(arm.get_err_warn_code()[1] == [2, 0], f"enabling before a reset: {arm.get_err_warn_code()}")
    enable(arm, 0)
    ok(arm.set_servo_angle(angle=start, speed=1, wait=True), "set_servo_angle after the stop")
    arm.disconnect()


def limits(host):
    """The run's limit of joint 1 is 1 rad; the client's own is 6.28 rad."""
    arm = connect(host)
    enable(arm, 0)
    start = angles(arm)
    beyond = [1.2, *start[1:]]
    check(arm.set_servo_angle(angle=beyond, speed=1, wait=True) == 1, "a move beyond the limit: the code of an error")
    check(arm.get_err_warn_code()[1] == [23, 0], "Joints Angle Exceed Limit")
    check(arm.set_servo_angle(angle=start, speed=1) != 0, "no motion in error")
    # Streamed towards the limit, and past it.
    enable(arm, 1)
    target, code = list(start), 0
    for _ in range(400):
        target[0] += 0.01
        code = arm.set_servo_angle_j(target)
        if code != 0:
            break
        time.sleep(0.01)
    check(code == 1 and 1.0 < target[0] < 1.02, f"refused with {code} at {target[0]}")
    check(arm.get_err_warn_code()[1] == [23, 0] and arm.get_state()[1] == 4, "Joints Angle Exceed Limit, stopped")
    time.sleep(0.5)
    check(0.9 < angles(arm)[0] <= 1.0, f"it is at {angles(arm)[0]}")
    # A jump: the run refuses it.
    enable(arm, 1)
    arm.set_servo_angle_j(start)
    until("the error", lambda: arm.error_code == 24)
    check(angles(arm)[0] > 0.9, "it has not jumped")
    enable(arm, 0)
    ok(arm.set_servo_angle(angle=start, speed=1, wait=True), "back")
    check(near(angles(arm), start), f"it is at {angles(arm)}")
    arm.disconnect()


def leased(host):
    """Another client commands the arm."""
    arm = connect(host)
    ok(arm.motion_enable(True), "motion_enable")
    ok(arm.set_mode(1), "set_mode")
    arm.set_state(0)
    check(arm.get_state()[1] == 4 and arm.get_err_warn_code()[1][0] == 27, f"{arm.get_err_warn_code()}")
    check(arm.set_servo_angle_j(angles(arm)) != 0, "no setpoint")
    meet("refused")
    enable(arm, 1)
    ok(arm.set_servo_angle_j(angles(arm)), "set_servo_angle_j")
    meet("taken")
    arm.disconnect()


def stream(host):
    """Streams velocities until the arm or the proxy is gone."""
    arm = connect(host)
    enable(arm, 4)
    ok(arm.vc_set_joint_velocity([0, 0, 0, 0, 0, 0.2]), "vc_set_joint_velocity")
    until("it moves", lambda: velocities(arm)[5] > 0.19)
    print("moving", flush=True)
    until("the end of the connection", lambda: not arm.connected or arm.get_state()[0] != 0, 30)


def other_stop(host):
    """Another program stops the arm during a move."""
    arm = connect(host)
    enable(arm, 0)
    goal = [angle + 0.5 for angle in angles(arm)]
    ok(arm.set_servo_angle(angle=goal, speed=0.2), "set_servo_angle")
    print("moving", flush=True)
    code = arm._arm.wait_move(timeout=20)
    check(code == -9, f"the wait ends with {code}")
    check(arm.get_state()[1] == 4, "state 4")
    arm.disconnect()


def hung(host):
    """The run stops answering."""
    arm = connect(host)
    enable(arm, 1)
    here = angles(arm)
    ok(arm.set_servo_angle_j(here), "set_servo_angle_j")
    meet("ready")
    until("state 4", lambda: arm.get_state()[1] == 4, 3)
    check(arm.set_servo_angle_j(here) != 0, "no setpoint")
    arm.disconnect()


def seven(host):
    arm = connect(host)
    check(arm.axis == 7, f"{arm.axis} axes")
    enable(arm, 0)
    goal = [angle + 0.1 for angle in angles(arm)]
    ok(arm.set_servo_angle(angle=goal, speed=0.5, wait=True), "set_servo_angle")
    check(near(angles(arm), goal), f"it is at {angles(arm)}")
    arm.disconnect()


def other_make(host):
    """An arm of another make, whose ranges the client does not know."""
    arm = connect(host, check_joint_limit=False)
    enable(arm, 0)
    goal = [angle + 0.1 for angle in angles(arm)]
    ok(arm.set_servo_angle(angle=goal, speed=0.5, wait=True), "set_servo_angle")
    check(near(angles(arm), goal, 2e-3), f"it is at {angles(arm)}")
    check(arm.get_position()[0] == 0, "get_position")
    arm.disconnect()


def no_kinematics(host):
    """A run that does not know where the tool is, and has no tasks for streams."""
    arm = connect(host)
    check(arm.get_position()[0] == 10, f"get_position without kinematics: {arm.get_position()}")
    check(arm.set_mode(1) == 10 and arm.set_mode(4) == 10, "modes without a task")
    enable(arm, 0)
    check(arm.set_position(300, 0, 300, 3.1, 0, 0, speed=100) == 10, "set_position")
    goal = [0.3, -0.2, -0.5, 0.1, 0.4]
    ok(arm.set_servo_angle(angle=goal, speed=1, wait=True), "set_servo_angle")
    check(near(angles(arm), goal, 2e-3), f"it is at {angles(arm)}")
    arm.disconnect()


SCENARIOS = [session, limits, leased, stream, other_stop, hung, seven, other_make, no_kinematics]
{scenario.__name__: scenario for scenario in SCENARIOS}[sys.argv[1]](sys.argv[2])
print("all is as it should be")
