"""Two libraries for Robotiq's grippers, and pymodbus itself, use the emulated gripper.

robotiq_libraries.py pyrobotiqgripper|robotiq2f DEVICE
robotiq_libraries.py pymodbus HOST:PORT
"""

import sys
import time


def wait(what, is_so, limit=10.0):
    end = time.monotonic() + limit
    while not is_so():
        assert time.monotonic() < end, what
        time.sleep(0.02)


def pyrobotiqgripper(device):
    import pyrobotiqgripper as rq

    gripper = rq.RobotiqGripper(com_port=device)
    gripper.connect()
    assert not gripper.isActivated()
    gripper.activate()
    assert gripper.isActivated()
    gripper.start()
    gripper.open()
    opened = gripper.position()
    gripper.close()
    closed = gripper.position()
    assert (opened, closed) == (3, 230), (opened, closed)
    # Function 23 writes and reads at once.
    gripper.move(100, speed=255, force=128)
    wait("at its position", lambda: gripper.position() == 100)
    gripper.calibrate_mm(0, 85)
    gripper.move_mm(40)
    assert abs(gripper.position_mm() - 40) < 1, gripper.position_mm()
    gripper.disconnect()


def robotiq2f(device):
    from robotiq2f import LinuxFindTTYWithSerialNumber, Robotiq2F85

    # A pseudo-terminal has no serial number.
    LinuxFindTTYWithSerialNumber.find = lambda self, number: device
    gripper = Robotiq2F85("none", async_control=False)
    gripper.reset()
    status = gripper.read_status()
    assert status.is_activated and not gripper.in_fault, status
    for opening in (85.0, 0.0, 40.0):
        gripper.go_to(opening, speed=150, force=100)
        wait(f"at {opening} mm", lambda opening=opening: abs(gripper.opening - opening) < 1)
        assert not gripper.object_detected
    gripper.close()


def pymodbus(address):
    from pymodbus.client import ModbusTcpClient

    host, port = address.split(":")
    client = ModbusTcpClient(host, port=int(port))
    assert client.connect()

    def status():
        return client.read_input_registers(2000, count=3, device_id=9).registers

    def activation():
        return status()[0] >> 12 & 3

    assert not client.write_registers(1000, [0, 0, 0], device_id=9).isError()
    assert activation() == 0
    assert not client.write_registers(1000, [0x0100, 0, 0], device_id=9).isError()
    wait("activated", lambda: activation() == 3)
    # One register, and three of them, which are read back.
    assert not client.write_register(1002, 0xFFFF, device_id=9).isError()
    assert not client.write_registers(1000, [0x0900, 120], device_id=9).isError()
    wait("there", lambda: status()[2] >> 8 == 120 and status()[0] >> 14 == 3)
    assert client.read_holding_registers(1000, count=3, device_id=9).registers == [0x0900, 120, 0xFFFF]
    assert client.read_input_registers(3000, count=1, device_id=9).isError()
    assert client.read_coils(0, count=1, device_id=9).isError()
    client.close()


if __name__ == "__main__":
    {"pyrobotiqgripper": pyrobotiqgripper, "robotiq2f": robotiq2f, "pymodbus": pymodbus}[sys.argv[1]](sys.argv[2])
    print("all is as it says")
