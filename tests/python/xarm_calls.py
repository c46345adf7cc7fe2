"""The calls of the vendor's client that `xarm_walk.py` makes: arguments, and what is true after a call that returns 0.

The test answers the line `truth?` with the true state as JSON.
"""

import json
import math
import sys
import time
from typing import Any, Callable, Optional

WHAT, HOST = sys.argv[1:]
EMULATED = WHAT == "emulator"
POSE = [0, -20, -30, 0, 50, 0]

# The client object's own affairs: nothing goes over the wire, or only what connecting needs.
LOCAL = [
    "connect",
    "disconnect",
    "set_timeout",
    "set_baud_checkset_enable",
    "set_checkset_default_baud",
    "get_checkset_default_baud",
    "set_rs485_use_503_port",
    "set_only_check_type",
]
# They speak to UFACTORY Studio, or run a program of the client's own calls.
STUDIO = [
    "get_trajectories",
    "delete_trajectory",
    "delete_blockly_app",
    "run_blockly_app",
    "run_gcode_app",
    "run_gcode_file",
    "get_initial_point",
    "set_initial_point",
    "get_mount_direction",
    "set_mount_direction",
]
# They return nothing, or not a code: judged by what they do.
WITHOUT_CODE = {"emergency_stop", "reset", "move_arc_lines", "send_cmd_sync", "get_is_moving"}


def truth():
    print("truth?", flush=True)
    return json.loads(sys.stdin.readline())


def near(a, b, limit=0.01):
    return len(a) == len(b) and all(abs(x - y) <= limit for x, y in zip(a, b))


def settle(arm, mode=0):
    """Ready at the pose, without error, in a mode."""
    arm.set_only_check_type(0)
    arm.clean_error()
    arm.clean_warn()
    if EMULATED:
        arm.motion_enable(True)
        arm.set_state(4)
    elif not truth()["motors"] or arm.get_state()[1] >= 4:
        arm.motion_enable(True)
    arm.set_mode(0)
    arm.set_state(0)
    wait(lambda: arm.state in (1, 2) and arm.mode == 0 and arm.error_code == 0, "ready")
    if not near(joints(), POSE, 0.05):
        code = arm.set_servo_angle(angle=POSE, speed=60, wait=True)
        assert code == 0, f"back to the pose: {code}, {arm.get_err_warn_code()}, state {arm.get_state()}"
    if mode:
        arm.set_mode(mode)
        arm.set_state(0)
        wait(lambda: arm.mode == mode and arm.state in (1, 2), f"mode {mode}")


def wait(holds, what, seconds=5):
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, f"not within {seconds} s: {what}"
        time.sleep(0.02)


def joints():
    return [math.degrees(q) for q in truth()["joints"]]


def moved(arm, pose, by):
    """Whether the tool has gone by these millimetres in the base."""
    now = arm.get_position()[1]
    return near([n - p for n, p in zip(now[:3], pose[:3])], by, 1.0)


def turned(joint, degrees):
    return lambda arm, before: abs(joints()[joint] - math.degrees(before["joints"][joint]) - degrees) < 0.2


def at(*goal):
    return lambda arm, before: near(joints(), goal, 0.2)


def tool(*by):
    return lambda arm, before: moved(arm, before["pose"], by)


def tool_down(arm, before):
    """The tool points down in the pose: 20 mm along it are 20 mm lower."""
    return moved(arm, before["pose"], [0, 0, -20])


def shows(holds, seconds=2):
    def judged(arm, before):
        end = time.monotonic() + seconds
        while not holds(arm):
            if time.monotonic() > end:
                return False
            time.sleep(0.05)
        return True

    return judged


def rests(arm, before):
    a = joints()
    time.sleep(0.1)
    return near(a, joints(), 0.01)


def reduced(index, wanted):
    """Whether this part of the box's reduced mode is so: mode, boundary, tool, joints, ranges of joints, fence."""

    def holds(arm):
        states = arm.get_reduced_states()[1]
        value = states[index] if isinstance(wanted, list) else [states[index]]
        wants = wanted if isinstance(wanted, list) else [wanted]
        return near(value[: len(wants)], wants, 0.5)

    return shows(holds)


def outputs(*levels):
    """Whether the first outputs of the tool board are at these levels."""
    return shows(lambda arm: arm.get_tgpio_output_digital()[1][: len(levels)] == list(levels))


def gripped(*pulses):
    """Whether the gripper is at one of these positions."""

    def at(opening):
        return opening is not None and any(abs(opening - p / 1e4) < 1e-3 for p in pulses)

    return shows(lambda arm: at(truth()["gripper"]), 4)


def pauses(arm, before):
    """The move behind the pause begins only after it."""
    start = joints()
    arm.set_servo_angle(servo_id=1, angle=5, speed=60)
    time.sleep(0.2)
    waits = near(joints(), start, 0.01)
    wait(lambda: abs(joints()[0] - 5) < 0.1, "the move after the pause")
    return waits


def slower(arm, before):
    """The gripper takes its speed: 30 mm at 1000 of 5000 r/min, 50 mm/s, take 0.6 s."""
    arm.set_gripper_position(800, wait=True)
    began = time.monotonic()
    arm.set_gripper_position(500, wait=True)
    return time.monotonic() - began > 0.4


# What would change something: arguments, the mode for it, and what must have changed if it returns 0.
CHANGES: dict[str, tuple[Callable[..., Any], int, Optional[Callable[..., Any]]]] = {
    "set_position": (
        lambda a, p: a.set_position(p[0], p[1], p[2] + 20, *p[3:], speed=80, wait=True),
        0,
        tool(0, 0, 20),
    ),
    "set_position relative": (lambda a, p: a.set_position(z=20, relative=True, speed=80, wait=True), 0, tool(0, 0, 20)),
    "set_position y only": (lambda a, p: a.set_position(y=30, speed=80, wait=True), 0, tool(0, 30, 0)),
    "set_tool_position": (lambda a, p: a.set_tool_position(z=20, speed=80, wait=True), 0, tool_down),
    "set_position_aa": (
        lambda a, p: a.set_position_aa([0, 0, 20, 0, 0, 0], relative=True, speed=80, wait=True),
        0,
        tool(0, 0, 20),
    ),
    "set_position_aa absolute": (lambda a, p: absolute_aa(a), 0, tool(10, 0, 0)),
    "set_position_aa tool": (
        lambda a, p: a.set_position_aa([0, 0, 20, 0, 0, 0], is_tool_coord=True, speed=80, wait=True),
        0,
        tool_down,
    ),
    "set_servo_angle": (lambda a, p: a.set_servo_angle(servo_id=1, angle=4, speed=40, wait=True), 0, at(4, *POSE[1:])),
    "set_servo_angle relative": (
        lambda a, p: a.set_servo_angle(servo_id=2, angle=-3, relative=True, speed=40, wait=True),
        0,
        None,
    ),
    "set_servo_angle all relative": (
        lambda a, p: a.set_servo_angle(angle=[0, 3, 0, 0, 0, 5], relative=True, speed=40, wait=True),
        0,
        at(0, -17, -30, 0, 50, 5),
    ),
    "set_servo_angle_j": (lambda a, p: a.set_servo_angle_j([2, *POSE[1:]]), 1, at(2, *POSE[1:])),
    "set_servo_angle_j jump": (lambda a, p: a.set_servo_angle_j([40, *POSE[1:]]), 1, None),
    "set_servo_cartesian": (lambda a, p: a.set_servo_cartesian([*p[:2], p[2] + 2, *p[3:]]), 1, tool(0, 0, 2)),
    "set_servo_cartesian_aa": (
        lambda a, p: a.set_servo_cartesian_aa([0, 0, 2, 0, 0, 0], relative=True),
        1,
        tool(0, 0, 2),
    ),
    "vc_set_joint_velocity": (
        lambda a, p: a.vc_set_joint_velocity([10, 0, 0, 0, 0, 0], duration=0.3),
        4,
        lambda arm, before: 1.5 < joints()[0] < 4.5,
    ),
    "vc_set_cartesian_velocity": (
        lambda a, p: a.vc_set_cartesian_velocity([0, 0, 30, 0, 0, 0], duration=0.5),
        4,
        tool(0, 0, 15),
    ),
    "move_gohome": (lambda a, p: a.move_gohome(speed=60, wait=True), 0, at(0, 0, 0, 0, 0, 0)),
    "reset": (lambda a, p: a.reset(speed=60, wait=True), 0, at(0, 0, 0, 0, 0, 0)),
    "move_circle": (
        lambda a, p: a.move_circle([p[0] + 20, p[1] + 20, *p[2:]], [p[0] + 40, *p[1:]], 100, speed=80, wait=True),
        0,
        None,
    ),
    "move_arc_lines": (
        lambda a, p: a.move_arc_lines([[*p[:2], p[2] + 10, *p[3:]]], speed=80, first_pause_time=0, wait=True),
        0,
        lambda arm, before: not EMULATED or moved(arm, before["pose"], [0, 0, 10]),
    ),
    "set_pause_time": (lambda a, p: a.set_pause_time(1.5), 0, pauses),
    "motion_enable": (lambda a, p: a.motion_enable(False), 0, shows(lambda arm: not truth()["motors"])),
    "set_servo_attach": (lambda a, p: a.set_servo_attach(8), 0, shows(lambda arm: truth()["motors"])),
    "set_servo_detach": (lambda a, p: a.set_servo_detach(1), 0, shows(lambda arm: not truth()["motors"])),
    "set_mode": (lambda a, p: a.set_mode(4), 0, shows(lambda arm: arm.mode == 4)),
    **{
        f"set_mode {m}": (lambda a, p, m=m: a.set_mode(m), 0, shows(lambda arm, m=m: arm.mode == m))
        for m in (1, 2, 3, 5, 6, 7, 11)
    },
    "set_state": (lambda a, p: a.set_state(4), 0, shows(lambda arm: arm.get_state()[1] == 4)),
    "set_state 3": (lambda a, p: a.set_state(3), 0, shows(lambda arm: arm.get_state()[1] == 3)),
    "set_state 6": (lambda a, p: a.set_state(6), 0, shows(lambda arm: arm.get_state()[1] in (4, 6))),
    "set_state 9": (lambda a, p: a.set_state(9), 0, None),
    "set_state stopped": (lambda a, p: (a.motion_enable(False), a.set_state(0))[1], 0, None),
    "emergency_stop": (lambda a, p: a.emergency_stop(), 0, shows(lambda arm: arm.get_state()[1] == 4)),
    "clean_error": (lambda a, p: a.clean_error(), 0, shows(lambda arm: arm.get_err_warn_code()[1][0] == 0)),
    "clean_warn": (lambda a, p: a.clean_warn(), 0, shows(lambda arm: arm.get_err_warn_code()[1][1] == 0)),
    "set_tcp_load": (
        lambda a, p: a.set_tcp_load(0.6, [0, 0, 30]),
        0,
        shows(lambda arm: near(arm.tcp_load[1], [0, 0, 30])),
    ),
    "set_tcp_offset": (
        lambda a, p: a.set_tcp_offset([0, 0, 100, 0, 0, 0]),
        0,
        lambda arm, before: near(arm.tcp_offset, [0, 0, 100, 0, 0, 0]) and moved(arm, before["pose"], [0, 0, -100]),
    ),
    "set_world_offset": (
        lambda a, p: a.set_world_offset([0, 0, 100, 0, 0, 0]),
        0,
        lambda arm, before: near(arm.world_offset, [0, 0, 100, 0, 0, 0]) and moved(arm, before["pose"], [0, 0, 100]),
    ),
    "set_tcp_jerk": (lambda a, p: a.set_tcp_jerk(8000), 0, shows(lambda arm: abs(arm.tcp_jerk - 8000) < 1)),
    "set_tcp_maxacc": (lambda a, p: a.set_tcp_maxacc(9000), 0, shows(lambda arm: abs(arm.tcp_acc_limit[1] - 9000) < 1)),
    "set_joint_jerk": (lambda a, p: a.set_joint_jerk(800), 0, shows(lambda arm: abs(arm.joint_jerk - 800) < 1)),
    "set_joint_maxacc": (
        lambda a, p: a.set_joint_maxacc(900),
        0,
        shows(lambda arm: abs(arm.joint_acc_limit[1] - 900) < 1),
    ),
    "set_collision_sensitivity": (
        lambda a, p: a.set_collision_sensitivity(5),
        0,
        shows(lambda arm: arm.collision_sensitivity == 5),
    ),
    "set_teach_sensitivity": (
        lambda a, p: a.set_teach_sensitivity(4),
        0,
        shows(lambda arm: arm.teach_sensitivity == 4),
    ),
    "save_conf": (lambda a, p: a.save_conf(), 0, rests),
    "clean_conf": (lambda a, p: a.clean_conf(), 0, shows(lambda arm: arm.collision_sensitivity == 3)),
    "set_report_tau_or_i": (
        lambda a, p: a.set_report_tau_or_i(1),
        0,
        shows(lambda arm: arm.get_report_tau_or_i() == (0, 1)),
    ),
    "set_linear_spd_limit_factor": (
        lambda a, p: a.set_linear_spd_limit_factor(1.1),
        0,
        lambda arm, before: abs(arm.get_linear_spd_limit_factor()[1] - 1.1) < 1e-3,
    ),
    "set_ft_sensor_enable": (
        lambda a, p: a.set_ft_sensor_enable(1),
        0,
        lambda arm, before: abs(arm.get_ft_sensor_data()[1][2] + 4.9) < 0.1,
    ),
    "set_ft_sensor_mode": (
        lambda a, p: a.set_ft_sensor_mode(0),
        0,
        lambda arm, before: arm.get_ft_sensor_mode() == (0, 0),
    ),
    "set_ft_sensor_mode 1": (lambda a, p: a.set_ft_sensor_mode(1), 0, None),
    "set_ft_sensor_zero": (
        lambda a, p: a.set_ft_sensor_zero(),
        0,
        lambda arm, before: near(arm.get_ft_sensor_data()[1], [0] * 6),
    ),
    "set_gripper_enable": (lambda a, p: a.set_gripper_enable(True), 0, rests),
    "set_gripper_mode": (lambda a, p: a.set_gripper_mode(0), 0, rests),
    "set_gripper_mode 1": (lambda a, p: a.set_gripper_mode(1), 0, None),
    "set_gripper_position": (lambda a, p: a.set_gripper_position(300, wait=True), 0, gripped(300)),
    "set_gripper_position far": (lambda a, p: a.set_gripper_position(2000), 0, None),
    "set_gripper_speed": (lambda a, p: a.set_gripper_speed(1000), 0, slower),
    "set_gripper_g2_position": (lambda a, p: a.set_gripper_g2_position(20), 0, gripped(200)),
    "clean_gripper_error": (
        lambda a, p: a.clean_gripper_error(),
        0,
        lambda arm, before: arm.get_gripper_err_code()[1] == 0,
    ),
    "set_tgpio_modbus_baudrate": (
        lambda a, p: a.set_tgpio_modbus_baudrate(2000000),
        0,
        lambda arm, before: arm.get_tgpio_modbus_baudrate() == (0, 2000000),
    ),
    "set_rs485_baudrate": (
        lambda a, p: a.set_rs485_baudrate(2000000),
        0,
        lambda arm, before: arm.get_rs485_baudrate() == (0, 2000000),
    ),
    # Outputs of the tool board, and the grippers that they open and close.
    "set_tgpio_digital": (lambda a, p: a.set_tgpio_digital(4, 1), 0, outputs(0, 0, 0, 0, 1)),
    "open_lite6_gripper": (lambda a, p: a.open_lite6_gripper(), 0, outputs(1, 0)),
    "close_lite6_gripper": (lambda a, p: a.close_lite6_gripper(), 0, outputs(0, 1)),
    "stop_lite6_gripper": (lambda a, p: a.stop_lite6_gripper(), 0, outputs(0, 0)),
    "set_vacuum_gripper": (lambda a, p: a.set_vacuum_gripper(True, wait=False), 0, outputs(1, 0)),
    # They ask the gripper for its error: its answer is right.
    "getset_tgpio_modbus_data": (
        lambda a, p: data(a.getset_tgpio_modbus_data([8, 3, 0, 15, 0, 1]), [8, 3, 2, 0, 0]),
        0,
        rests,
    ),
    "set_rs485_data": (lambda a, p: data(a.set_rs485_data([8, 3, 0, 15, 0, 1]), [8, 3, 2, 0, 0]), 0, rests),
    # A bio gripper has the telegrams of a G1: what they move here is the G1.
    "close_bio_gripper": (lambda a, p: a.close_bio_gripper(wait=False), 0, gripped(50, 71)),
    "open_bio_gripper": (lambda a, p: a.open_bio_gripper(wait=False), 0, gripped(130, 150)),
    "send_cmd_sync": (
        lambda a, p: a.send_cmd_sync("G7 I4 J-20 K-30 L0 M50 N0 F40"),
        0,
        shows(lambda arm: near(joints(), [4, *POSE[1:]], 0.2)),
    ),
    "send_hex_cmd": (lambda a, p: raw(a.send_hex_cmd(["00", "07", "00", "02", "00", "01", "FA"])), 0, None),
    # Limits of reduced mode, so wide that nothing else is judged by them; the walk switches it off again.
    "set_reduced_max_tcp_speed": (lambda a, p: a.set_reduced_max_tcp_speed(900), 0, reduced(2, 900)),
    "set_reduced_max_joint_speed": (lambda a, p: a.set_reduced_max_joint_speed(170), 0, reduced(3, 170)),
    "set_reduced_joint_range": (lambda a, p: a.set_reduced_joint_range([-360, 360] * 7), 0, reduced(4, [-360, 360])),
    "set_reduced_tcp_boundary": (
        lambda a, p: a.set_reduced_tcp_boundary([2000, -2000] * 3),
        0,
        reduced(1, [2000, -2000] * 3),
    ),
    "set_reduced_mode": (lambda a, p: a.set_reduced_mode(True), 0, reduced(0, 1)),
    "set_fence_mode": (lambda a, p: a.set_fence_mode(True)[0], 0, reduced(5, 1)),
    "set_collision_rebound": (lambda a, p: a.set_collision_rebound(True), 0, reduced(6, 1)),
    "only_check_type 1": (lambda a, p: checked(a, p), 0, at(*POSE)),
}

# Arguments of methods that have no effect here: whatever they return, it is not 0.
X = [0.0] * 6
REFUSED = {
    "calibrate_tcp_coordinate_offset": ([X] * 4,),
    "calibrate_tcp_orientation_offset": ([0] * 3, [0] * 3),
    "calibrate_user_coordinate_offset": ([0] * 3, [0] * 3),
    "calibrate_user_orientation_offset": ([X] * 3,),
    "check_verification": (),
    "clean_bio_gripper_error": (),
    "clean_linear_motor_error": (),
    "config_cgpio_reset_when_stop": (True,),
    "config_tgpio_reset_when_stop": (True,),
    "iden_ft_sensor_load_offset": (),
    "iden_joint_friction": ("XI130500000000",),
    "iden_tcp_load": (),
    "load_trajectory": ("a", False),
    "playback_trajectory": (1, None, False),
    "save_record_trajectory": ("a", False),
    "start_record_trajectory": (),
    "stop_record_trajectory": (),
    "mask_write_holding_register": (0, 1, 1),
    "read_coil_bits": (0, 1),
    "read_holding_registers": (0, 1),
    "read_input_bits": (0, 1),
    "read_input_registers": (0, 1),
    "write_and_read_holding_registers": (0, 1, 0, [1]),
    "write_multiple_coil_bits": (0, [1]),
    "write_multiple_holding_registers": (0, [1]),
    "write_single_coil_bit": (0, 1),
    "write_single_holding_register": (0, 1),
    "robotiq_close": (255, 255, False),
    "robotiq_get_status": (),
    "robotiq_open": (255, 255, False),
    "robotiq_reset": (),
    "robotiq_set_activate": (False,),
    "robotiq_set_position": (100, 255, 255, False),
    "set_allow_approx_motion": (True,),
    "set_bio_gripper_control_mode": (1,),
    "set_bio_gripper_enable": (True, False),
    "set_bio_gripper_force": (50,),
    "set_bio_gripper_g2_position": (100, 2000, 100, False),
    "set_bio_gripper_speed": (100,),
    "set_cartesian_velo_continuous": (True,),
    "set_cgpio_analog": (0, 5),
    "set_cgpio_analog_with_xyz": (0, 5, [0] * 3, 1),
    "set_cgpio_digital": (0, 1),
    "set_cgpio_digital_input_function": (0, 1),
    "set_cgpio_digital_output_function": (0, 1),
    "set_cgpio_digital_with_xyz": (0, 1, [0] * 3, 1),
    "set_cmd_mat_history_num": (1,),
    "set_collision_tool_model": (1,),
    "set_counter_increase": (),
    "set_counter_reset": (),
    "set_dh_params": ([0.0] * 28,),
    "set_dhpgc_gripper_activate": (False,),
    "set_dhpgc_gripper_position": (10, 50, 50, False),
    "set_external_device_monitor_params": (1, 1),
    "set_fdb_mat_history_num": (1,),
    "set_feedback_type": (1,),
    "set_ft_admittance_ctrl_threshold": ([1] * 6,),
    "set_ft_collision_detection": (1,),
    "set_ft_collision_reb_distance": ([1] * 6,),
    "set_ft_collision_rebound": (1,),
    "set_ft_collision_threshold": ([10] * 6,),
    "set_ft_sensor_admittance_parameters": (0, [0] * 6, [0.1] * 6, [10] * 6, [0] * 6),
    "set_ft_sensor_force_parameters": (0, [0] * 6, [0] * 6, [0] * 6),
    "set_ft_sensor_load_offset": ([0.0] * 10,),
    "set_gravity_direction": ([0, 0, 1],),
    "set_linear_motor_back_origin": (False,),
    "set_linear_motor_enable": (True,),
    "set_linear_motor_pos": (10, 100, False),
    "set_linear_motor_speed": (100,),
    "set_linear_motor_stop": (),
    "set_modbusrtu_params": (1, 115200),
    "set_rh56_finger_position": (1, 100),
    "set_rs485_timeout": (10,),
    "set_self_collision_detection": (True,),
    "set_simulation_robot": (True,),
    "set_tgpio_digital_with_xyz": (0, 1, [0] * 3, 1),
    "set_tgpio_modbus_timeout": (10,),
    "set_tgpio_monitor_params": (1, 1),
    "set_xarm7_ik_redundancy": ([0.0] * 7, 1),
    "system_control": (1,),
}

# Queries, and what their values must be if they return 0.
QUERIES = {
    "get_version": lambda a, v: v.endswith("v2.5.1"),
    "get_robot_sn": lambda a, v: v.startswith("XI1305"),
    "get_state": lambda a, v: v == 2,
    "get_is_moving": lambda a, v: v is False,
    "get_reduced_mode": lambda a, v: v == 0,
    "get_reduced_states": lambda a, v: v[0] == 0 and v[2] > 0 and near(v[4][:2], [-360, 360], 0.5),
    "get_cmdnum": lambda a, v: v == 0,
    "get_err_warn_code": lambda a, v: v == [0, 0],
    "get_position": lambda a, v: near(v, a.position, 0.5),
    "get_position_aa": lambda a, v: near(v[:3], a.position[:3], 0.5),
    "get_servo_angle": lambda a, v: near(v[:6], joints(), 0.05),
    "get_joint_states": lambda a, v: near(v[0][:6], joints(), 0.05) and near(v[1][:6], [0] * 6, 0.05),
    "get_joints_torque": lambda a, v: all(math.isfinite(x) for x in v),
    "get_forward_kinematics": lambda a, v: near(v[:3], a.position[:3], 0.5),
    "get_inverse_kinematics": lambda a, v: near(v[:6], joints(), 0.1),
    "is_joint_limit": lambda a, v: v is False,
    "get_report_tau_or_i": lambda a, v: v == 0,
    "get_linear_spd_limit_factor": lambda a, v: abs(v - 1.2) < 1e-3,
    "get_ft_sensor_data": lambda a, v: all(math.isfinite(x) for x in v),
    "get_ft_sensor_mode": lambda a, v: v == 0,
    "get_servo_debug_msg": lambda a, v: all(joint["status"] == 0 and joint["code"] == 0 for joint in v),
    "get_gripper_position": lambda a, v: abs(v - truth()["gripper"] * 1e4) < 6,
    "get_gripper_err_code": lambda a, v: v == 0,
    "get_gripper_version": lambda a, v: v == "3.4.3",
    "get_gripper_status": lambda a, v: v in (0, 2),
    # A G1's pulses have another meaning here; nothing moves.
    "get_gripper_g2_position": lambda a, v: math.isfinite(v),
    "get_tgpio_modbus_baudrate": lambda a, v: v == 2000000,
    "get_rs485_baudrate": lambda a, v: v == 2000000,
    "get_tgpio_digital": lambda a, v: not any(v),
    "get_tool_digital_input": lambda a, v: not any(v),
    "get_tgpio_output_digital": lambda a, v: not any(v),
    "get_tgpio_analog": lambda a, v: near(v, [0, 0], 0.01),
    "get_vacuum_gripper": lambda a, v: v == -1,  # off
    # The client's own: what it has last seen.
    "get_bio_gripper_error": None,
    "get_linear_motor_registers": None,
    # Of the G1, whose telegrams they share.
    "get_bio_gripper_status": lambda a, v: v in (0, 2),
    "get_bio_gripper_g2_position": lambda a, v: math.isfinite(v),
}
ARGUMENTS = {
    "get_forward_kinematics": (POSE,),
    "is_joint_limit": (POSE,),
    "is_tcp_limit": (X,),
    "get_pose_offset": (X, X),
    "get_traj_speeding": (1,),
}


def absolute_aa(arm):
    x, y, z, *turn = arm.get_position_aa()[1]
    return arm.set_position_aa([x + 10, y, z, *turn], speed=80, wait=True)


def raw(answer):
    """What a frame's state byte says of an unknown register."""
    code, frame = answer
    state = frame[7] if isinstance(frame[7], int) else int(frame[7], 16)
    return code or (10 if state & 0x08 else 0)


def data(answer, expected):
    code, got = answer
    assert code != 0 or list(got) == expected, f"{got}"
    return code


def checked(arm, pose):
    """Only checks a move: the arm stays."""
    code = arm.set_position(pose[0], pose[1], pose[2] + 20, *pose[3:], speed=80, only_check_type=1)
    assert arm.set_position(5000, 0, 0, speed=80, only_check_type=1) != 0, "a check finds what is out of reach"
    return code
