"""The vendor's own client against the arm at a host: `xarm_sdk.py SCENARIO HOST`."""

import math
import sys
import time

from xarm.wrapper import XArmAPI


def check(holds, what):
    if not holds:
        raise AssertionError(what)


def ok(code, what):
    check(code == 0, f"{what} returns {code}")


def until(what, holds, seconds=20):
    end = time.monotonic() + seconds
    while not holds():
        check(time.monotonic() < end, f"not within {seconds} s: {what}")
        time.sleep(0.02)


def near(a, b, limit):
    return all(abs(x - y) < limit for x, y in zip(a, b))


def connect(host, **more):
    arm = XArmAPI(host, is_radian=True, **more)
    check(arm.connected, "connected")
    return arm


def enable(arm, mode):
    ok(arm.clean_warn(), "clean_warn")
    ok(arm.motion_enable(True), "motion_enable")
    ok(arm.set_mode(mode), "set_mode")
    ok(arm.set_state(0), "set_state")
    motors = lambda: all(arm.motor_enable_states[: arm.axis])
    until(f"mode {mode}", lambda: arm.mode == mode and arm.state in (1, 2) and motors())


def session(host):
    arm = connect(host)
    check(arm.version_number == (2, 5, 1), f"version {arm.version_number}")
    check((arm.axis, arm.device_type) == (6, 6), f"{arm.axis} axes, type {arm.device_type}")
    check(arm.get_robot_sn()[1].startswith("XI1305"), "serial number")
    start = arm.get_servo_angle()[1][:6]
    check(start[1] < -0.5, f"it is at its initial position, in rad: {start}")

    # Planned moves: joints, then the tool in a line.
    enable(arm, 0)
    check(near(arm.get_servo_angle()[1], start, 1e-4), "enabling moves nothing")
    goal = [0.2, -0.5, -0.9, 0.1, 1.3, -0.1]
    ok(arm.set_servo_angle(angle=goal, speed=1.0, wait=True), "set_servo_angle")
    check(near(arm.get_servo_angle()[1], goal, 1e-3), f"it is at {arm.get_servo_angle()[1]}")
    ok(arm.set_servo_angle(servo_id=1, angle=0.3, speed=1.0, wait=True), "one joint")
    goal[0] = 0.3
    check(near(arm.get_servo_angle()[1], goal, 1e-3), "the others stay")
    pose = arm.get_position()[1]
    reach = math.hypot(pose[0], pose[1])
    check(200 < reach < 700, f"millimetres: {pose}")
    code, computed = arm.get_forward_kinematics(goal)
    check(code == 0 and near(computed, pose, 0.5), f"forward kinematics: {computed}, reported {pose}")
    target = [pose[0], pose[1] + 30, pose[2] + 20, *pose[3:]]
    ok(arm.set_position(*target, speed=100, wait=True), "set_position")
    check(near(arm.get_position()[1], target, 1.0), f"{arm.get_position()[1]} for {target}")
    ok(arm.set_servo_angle(angle=goal, speed=1.0, wait=True), "back")

    # Setpoints, at 100 Hz.
    enable(arm, 1)
    for i in range(100):
        joints = list(goal)
        joints[3] += 0.1 * (1 - math.cos(2 * math.pi * i / 100)) / 2
        ok(arm.set_servo_angle_j(joints), "set_servo_angle_j")
        time.sleep(0.01)
    ok(arm.set_servo_angle_j(goal), "set_servo_angle_j")
    until("the last setpoint", lambda: near(arm.get_servo_angle()[1], goal, 2e-3))

    # Velocities, which time out.
    enable(arm, 4)
    for _ in range(30):
        ok(arm.vc_set_joint_velocity([0, 0, 0, 0, 0, 0.2], duration=0.2), "vc_set_joint_velocity")
        time.sleep(0.01)
    states = arm.get_joint_states()[1]
    check(abs(states[1][5] - 0.2) < 0.05, f"rad/s: {states[1]}")
    until("the end of the velocity", lambda: abs(arm.get_joint_states()[1][1][5]) < 1e-3)
    check(arm.get_servo_angle()[1][5] > goal[5] + 0.02, "it has turned")

    # The gripper, in pulses; the sensor, in newtons.
    ok(arm.set_gripper_enable(True), "set_gripper_enable")
    ok(arm.set_gripper_mode(0), "set_gripper_mode")
    ok(arm.set_gripper_speed(3000), "set_gripper_speed")
    ok(arm.set_gripper_position(400, wait=True), "set_gripper_position")
    code, pulses = arm.get_gripper_position()
    check(code == 0 and abs(pulses - 400) <= 1, f"get_gripper_position: {code}, {pulses}")
    check(arm.get_gripper_version() == (0, "3.4.3"), "get_gripper_version")
    ok(arm.ft_sensor_enable(1), "ft_sensor_enable")
    code, wrench = arm.get_ft_sensor_data()
    check(code == 0 and abs(wrench[2] + 4.9) < 0.01, f"get_ft_sensor_data: {code}, {wrench}")

    # A stop, and the mode that is lost when it is changed while ready.
    arm.emergency_stop()
    until("the stop", lambda: arm.state == 4)
    check(arm.set_servo_angle_j(goal) != 0, "a setpoint after a stop is refused")
    enable(arm, 1)
    ok(arm.set_mode(4), "set_mode")
    ok(arm.set_state(0), "set_state")
    until("mode 0", lambda: arm.mode == 0 and arm.state == 2)
    arm.disconnect()


def errors(host):
    arm = connect(host)
    enable(arm, 0)
    until("the error", lambda: arm.error_code == 31)
    check(arm.get_err_warn_code()[1] == [31, 0], "get_err_warn_code")
    check(arm.state == 4, f"state {arm.state}")
    check(arm.set_servo_angle(angle=[0.2] * 7, speed=0.5) != 0, "no motion in error")
    arm.clean_error()
    until("no error", lambda: arm.error_code == 0)
    enable(arm, 0)
    goal = [angle + 0.05 for angle in arm.get_servo_angle()[1]]
    ok(arm.set_servo_angle(angle=goal, speed=0.5, wait=True), "set_servo_angle after the error")
    # Beyond a limit: the client itself refuses, the controller too.
    check(arm.set_servo_angle_j([9.0] * 7) != 0, "out of range")
    ok(arm.motion_enable(False), "motion_enable")
    until("motors off", lambda: not any(arm.motor_enable_states[:7]))
    arm.disconnect()


def model(host, axes, kind):
    arm = connect(host)
    check((arm.axis, arm.device_type) == (axes, kind), f"{arm.axis} axes, type {arm.device_type}")
    enable(arm, 0)
    start = arm.get_servo_angle()[1][:axes]
    goal = [angle + 0.1 for angle in start]
    ok(arm.set_servo_angle(angle=goal, speed=1.0, wait=True), "set_servo_angle")
    check(near(arm.get_servo_angle()[1], goal, 1e-3), "it arrives")
    arm.disconnect()


def old(host):
    for report in ("rich", "normal", "real"):
        arm = connect(host, report_type=report)
        check(arm.version_number == (1, 12, 10), f"version {arm.version_number}")
        until("reports", lambda: near(arm.angles, arm.get_servo_angle()[1], 1e-3) and arm.angles[1] != 0)
        arm.disconnect()


def takeover(host, pause):
    arm = connect(host)
    start = arm.get_servo_angle()[1][:6]
    goal = [angle + 0.4 for angle in start]
    ok(arm.set_mode(0), "set_mode")
    time.sleep(pause)
    ok(arm.set_state(0), "set_state")
    time.sleep(pause)
    ok(arm.set_servo_angle(angle=goal, speed=3, wait=True), "set_servo_angle")
    time.sleep(1.0)
    check(near(arm.get_servo_angle()[1], goal, 1e-3), f"it was taken to {arm.get_servo_angle()[1]}, not left at {goal}")
    arm.disconnect()


SCENARIOS = {
    "takeover-0": lambda host: takeover(host, 0),
    "takeover-5": lambda host: takeover(host, 0.005),
    "takeover-200": lambda host: takeover(host, 0.2),
    "session": session,
    "errors": errors,
    "old": old,
    "xarm5": lambda host: model(host, 5, 5),
    "xarm7": lambda host: model(host, 7, 7),
    "lite6": lambda host: model(host, 6, 9),
    "xarm850": lambda host: model(host, 6, 12),
}

SCENARIOS[sys.argv[1]](sys.argv[2])
print("all is as it should be")
