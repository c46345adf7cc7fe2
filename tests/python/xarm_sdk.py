"""The vendor's own client against the arm at a host: `xarm_sdk.py SCENARIO HOST`."""

import math
import sys
import time
from functools import partial

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

    def motors():
        return all(arm.motor_enable_states[: arm.axis])

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


def reports(arm):
    return near(arm.angles, arm.get_servo_angle()[1], 1e-3) and arm.angles[1] != 0


def old(host):
    for report in ("rich", "normal", "real"):
        arm = connect(host, report_type=report)
        check(arm.version_number == (1, 12, 10), f"version {arm.version_number}")
        until("reports", partial(reports, arm))
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


def stream(arm, joint, speed):
    """Setpoints of one joint at a speed, until the controller refuses one, for 3 s at most."""
    joints, end = list(arm.get_servo_angle()[1]), time.monotonic() + 3
    while arm.error_code == 0 and time.monotonic() < end:
        joints[joint] += speed * 0.01
        arm.set_servo_angle_j(joints)
        time.sleep(0.01)


def reduced(host):
    arm = connect(host)
    check(arm.get_reduced_mode() == (0, 0), f"get_reduced_mode: {arm.get_reduced_mode()}")
    # What is set is what is read, and reported.
    ranges, boundary = [-6.0, 6.0, -1.5, 1.5, -3.0, 0.1, -6.0, 6.0, -1.6, 3.0, -6.0, 0.3, 0.0, 0.0], [900, -900] * 3
    ok(arm.set_reduced_max_tcp_speed(250), "set_reduced_max_tcp_speed")
    ok(arm.set_reduced_max_joint_speed(0.5), "set_reduced_max_joint_speed")
    ok(arm.set_reduced_joint_range(ranges), "set_reduced_joint_range")
    ok(arm.set_reduced_tcp_boundary(boundary), "set_reduced_tcp_boundary")
    ok(arm.set_fence_mode(True)[0], "set_fence_mode")
    ok(arm.set_reduced_mode(True), "set_reduced_mode")
    check(arm.get_reduced_mode() == (0, 1), "get_reduced_mode")
    code, states = arm.get_reduced_states()
    check(code == 0 and states[:2] == [1, boundary] and states[5:] == [1, 0], f"get_reduced_states: {code}, {states}")
    check(near(states[2:4], [250, 0.5], 1e-3) and near(states[4], ranges, 1e-3), f"get_reduced_states: {states}")
    until("the report", lambda: arm.is_reduced_mode and arm.is_fence_mode and arm.reduced_max_tcp_speed == 250)
    check(near([arm.reduced_max_joint_speed], [0.5], 1e-3), f"{arm.reduced_max_joint_speed}")
    check(near(arm.reduced_joint_limits[5], ranges[10:12], 1e-3), f"{arm.reduced_joint_limits}")
    # The box plans slower moves.
    enable(arm, 0)
    start, began = list(arm.get_servo_angle()[1]), time.monotonic()
    ok(arm.set_servo_angle(angle=[start[0] + 0.5, *start[1:]], speed=3.0, wait=True), "set_servo_angle")
    check(time.monotonic() - began > 0.95, "a move of 0.5 rad takes 1 s at 0.5 rad/s")

    def fails(what, code, mode, act):
        enable(arm, mode)
        act()
        until(what, lambda: arm.error_code != 0)
        check(arm.error_code == code, f"{what}: error {arm.error_code}")
        arm.clean_error()
        until("no error", lambda: arm.error_code == 0)

    def turns(joint, speed):
        return lambda: arm.vc_set_joint_velocity([0] * joint + [speed], duration=9)

    fails("a joint that is too fast", 24, 1, lambda: stream(arm, 5, 1.0))
    fails("a velocity that is too high", 24, 4, turns(5, 0.8))
    fails("a joint outside its range", 23, 1, lambda: stream(arm, 5, 0.3))
    fails("a velocity out of the range", 23, 4, turns(5, 0.3))
    # Back into the range, without its limits.
    ok(arm.set_reduced_mode(False), "set_reduced_mode")
    enable(arm, 0)
    ok(arm.set_servo_angle(angle=start, speed=1.0, wait=True), "set_servo_angle")
    # A limit that is set takes effect when reduced mode is switched on again.
    ok(arm.set_reduced_max_tcp_speed(50), "set_reduced_max_tcp_speed")
    ok(arm.set_reduced_mode(True), "set_reduced_mode")
    fails("a tool that is too fast", 60, 1, lambda: stream(arm, 0, 0.45))
    ok(arm.set_reduced_mode(False), "set_reduced_mode")
    # The boundary holds without reduced mode.
    z = int(arm.get_position()[1][2])
    ok(arm.set_reduced_tcp_boundary([900, -900, 900, -900, z + 20, -900]), "set_reduced_tcp_boundary")
    enable(arm, 0)

    def rise():
        return arm.set_position(z=z + 60, speed=50, wait=False)

    fails("a tool outside the boundary", 35, 0, rise)
    ok(arm.set_fence_mode(False)[0], "set_fence_mode")
    enable(arm, 0)
    ok(arm.set_position(z=z, speed=50, wait=True), "back")
    arm.disconnect()


def tool_line(host):
    arm = connect(host)
    ok(arm.set_tgpio_modbus_baudrate(115200), "set_tgpio_modbus_baudrate")
    check(arm.get_tgpio_modbus_baudrate() == (0, 115200), "get_tgpio_modbus_baudrate")
    for port_503 in (False, True):
        answer = arm.getset_tgpio_modbus_data(
            list(b"hello"), min_res_len=5, is_transparent_transmission=True, use_503_port=port_503
        )
        check(answer == (0, list(b"HELLO")), f"transparent, 503 {port_503}: {answer}")
    # Modbus: the box adds the checksum, and takes it away.
    answer = arm.getset_tgpio_modbus_data(list(b"abc"), min_res_len=3)
    check(answer[0] != 0, f"no device of Modbus: {answer}")
    arm.disconnect()


SCENARIOS = {
    "reduced": reduced,
    "tool-line": tool_line,
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
