"""LeRobot's own bus on a line of emulated servos.

The servos of an arm have the numbers from 1 on, or from the one on that is the last argument.

lerobot_bus.py use PATH FILE: everything that its SO-101 follower does with the bus, and its calibration into FILE;
prints each different packet that it sent, in hexadecimal.
lerobot_bus.py calibrated PATH FILE: whether the servos have the calibration of FILE, and FILE is as LeRobot writes it.
lerobot_bus.py setup PATH NAME: gives the only servo on the line the number of NAME.
"""

import io
import sys
import time
import types

# Two helpers for terminals; their module imports torch and much else, which the bus needs nothing of.
terminal = types.ModuleType("lerobot.utils.utils")
vars(terminal).update(dict.fromkeys(["enter_pressed", "move_cursor_up"], lambda *_: None))
sys.modules["lerobot.utils.utils"] = terminal

import draccus  # noqa: E402
import scservo_sdk  # noqa: E402
from lerobot.motors import Motor, MotorCalibration, MotorNormMode  # noqa: E402
from lerobot.motors.feetech import FeetechMotorsBus, OperatingMode  # noqa: E402

NAMES = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]
FIRST = int(sys.argv.pop()) if sys.argv[-1].isdigit() else 1
SENT = []
write_port = scservo_sdk.PortHandler.writePort


def keep(port, packet):
    SENT.append(bytes(packet).hex())
    return write_port(port, packet)


scservo_sdk.PortHandler.writePort = keep


def check(what, holds):
    if not holds:
        sys.exit(f"wrong: {what}")


def bus_at(path, calibration=None):
    def motor(number, name):
        norm = MotorNormMode.RANGE_0_100 if name == "gripper" else MotorNormMode.DEGREES
        return Motor(number, "sts3215", norm)

    motors = {name: motor(number, name) for number, name in enumerate(NAMES, FIRST)}
    bus = FeetechMotorsBus(port=path, motors=motors, calibration=calibration)
    # It waits 50 ms for an answer; the emulator's thread may have to wait longer for a busy processor.
    brief = bus.port_handler.setPacketTimeout

    def patient(length):
        brief(length)
        bus.port_handler.packet_timeout += 1000

    bus.port_handler.setPacketTimeout = patient
    return bus


def use(path, file):
    bus = bus_at(path)
    bus.connect()
    before = bus.read_calibration()
    check(f"the offsets are those of new servos: {before}", all(entry.homing_offset == 0 for entry in before.values()))
    bus.calibration = before
    check("the servos have what was read", bus.is_calibrated)
    # As its calibration does, with ranges as if they were recorded.
    bus.disable_torque()
    for name in NAMES:
        bus.write("Operating_Mode", name, OperatingMode.POSITION.value)
    offsets = bus.set_half_turn_homings()
    middle = bus.sync_read("Present_Position", normalize=False)
    check(f"the middle pose reads 2047: {middle}", set(middle.values()) == {2047})
    calibration = {}
    for number, name in enumerate(NAMES, FIRST):
        low, high = (0, 4095) if name == "wrist_roll" else (before[name].range_min, before[name].range_max)
        low, high = (low, high) if name == "wrist_roll" else (low - offsets[name], high - offsets[name])
        calibration[name] = MotorCalibration(number, 0, offsets[name], low, high)
    bus.write_calibration(calibration)
    check("it is calibrated", bus.is_calibrated)
    with open(file, "w") as out, draccus.config_type("json"):
        draccus.dump(calibration, out, indent=4)
    # As its configuration does.
    with bus.torque_disabled():
        bus.configure_motors()
        for name in NAMES:
            bus.write("Operating_Mode", name, OperatingMode.POSITION.value)
            bus.write("P_Coefficient", name, 16)
            bus.write("I_Coefficient", name, 0)
            bus.write("D_Coefficient", name, 32)
        bus.write("Max_Torque_Limit", "gripper", 500)
        bus.write("Protection_Current", "gripper", 250)
        bus.write("Overload_Torque", "gripper", 25)
    check("the gripper's limit", bus.read("Max_Torque_Limit", "gripper") == 500)
    here = bus.sync_read("Present_Position", normalize=False)
    bus.sync_write("Goal_Position", here, normalize=False)
    goals = {name: position + (60 if number % 2 else -60) for number, (name, position) in enumerate(here.items())}
    bus.sync_write("Goal_Position", goals, normalize=False)
    end = time.time() + 5
    while bus.sync_read("Present_Position", normalize=False) != goals and time.time() < end:
        pass
    check("it arrived", bus.sync_read("Present_Position", normalize=False) == goals)
    # In degrees, by its calibration.
    degrees = bus.sync_read("Present_Position")
    middle = (calibration["elbow_flex"].range_min + calibration["elbow_flex"].range_max) / 2
    wanted = (goals["elbow_flex"] - middle) * 360 / 4095
    check(f"degrees {degrees}", abs(degrees["elbow_flex"] - wanted) < 1e-9 and 0 < degrees["gripper"] < 100)
    check("torque is on", set(bus.sync_read("Torque_Enable", normalize=False).values()) == {1})
    bus.disconnect()
    print("\n".join(dict.fromkeys(SENT)))


def calibrated(path, file):
    with open(file) as text, draccus.config_type("json"):
        calibration = draccus.load(dict[str, MotorCalibration], text)
        out = io.StringIO()
        draccus.dump(calibration, out, indent=4)
    with open(file) as text:
        check("the file is as LeRobot writes it", text.read() == out.getvalue())
    bus = bus_at(path, calibration)
    bus.connect()
    check("the servos have the calibration of the file", bus.is_calibrated)
    bus.disconnect()
    print("as it says")


def setup(path, name):
    bus = bus_at(path)
    bus.setup_motor(name)
    check("it answers by its number", bus.ping(name) == 777)
    bus.port_handler.closePort()
    print("as it says")


{"use": use, "calibrated": calibrated, "setup": setup}[sys.argv[1]](*sys.argv[2:])
