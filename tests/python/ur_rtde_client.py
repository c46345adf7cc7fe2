"""`ur_rtde` on an emulated controller: ur_rtde_client.py use ADDRESS. Or, with `bytes`, prints the packets with which
it asks for values, one in hexadecimal a line."""

import multiprocessing
import socket
import sys
import time
from functools import partial

# Its clients keep the interpreter's lock while they connect, so what they connect to is in another process.
PROXY = "127.48.17.7"


def check(what, holds):
    if not holds:
        sys.exit(f"wrong: {what}")


def within(what, seconds, holds):
    end = time.time() + seconds
    while not holds():
        check(what, time.time() < end)
        time.sleep(0.01)


def near(a, b, tolerance=2e-3):
    return all(abs(x - y) < tolerance for x, y in zip(a, b))


def power_on(address):
    import dashboard_client

    dashboard = dashboard_client.DashboardClient(address)
    dashboard.connect()
    check("version", "5.11" in dashboard.polyscopeVersion())
    check("remote control", dashboard.isInRemoteControl())
    dashboard.powerOn()
    within("power", 5, lambda: "IDLE" in dashboard.robotmode())
    dashboard.brakeRelease()
    within("brakes", 5, lambda: "RUNNING" in dashboard.robotmode())
    check("safety", "NORMAL" in dashboard.safetystatus())
    check("no program", not dashboard.running())
    return dashboard


def use(address):
    import rtde_control
    import rtde_io
    import rtde_receive

    dashboard = power_on(address)
    receive = rtde_receive.RTDEReceiveInterface(address)
    start = receive.getActualQ()
    check(f"pose {start}", near(start, [0.3, -1.4, 1.5, -1.7, -1.5, 0.4]))
    check("modes", (receive.getRobotMode(), receive.getSafetyMode()) == (7, 1))
    check("inputs", receive.getActualDigitalInputBits() == (1 << 18) - 1)

    control = rtde_control.RTDEControlInterface(address)
    check("its program runs", dashboard.running() and control.isProgramRunning())
    goal = [q + 0.1 * (-1) ** i for i, q in enumerate(start)]
    check("moveJ", control.moveJ(goal, 1.0, 2.0))
    check(f"arrival {receive.getActualQ()}", near(receive.getActualQ(), goal))

    # A line: 5 cm along x.
    pose = receive.getActualTCPPose()
    check("moveL", control.moveL([pose[0] + 0.05, *pose[1:]], 0.2, 0.5))
    check("straight", near(receive.getActualTCPPose(), [pose[0] + 0.05, *pose[1:]]))

    here = receive.getActualQ()
    for i in range(250):
        period = control.initPeriod()
        point = [here[0] + 0.2 * i / 250, *here[1:]]
        check("servoJ", control.servoJ(point, 0, 0, 0.002, 0.05, 300))
        control.waitPeriod(period)
    within("the last setpoint", 3, lambda: near(receive.getActualQ(), point))
    control.servoStop()

    control.speedJ([0.3, 0, 0, 0, 0, 0], 2.0)
    within("speedJ", 3, lambda: abs(receive.getActualQd()[0] - 0.3) < 0.02)
    control.speedStop()
    within("rest", 3, lambda: max(map(abs, receive.getActualQd())) < 1e-3)

    check("setPayload", control.setPayload(1.5, [0.0, 0.0, 0.05]))
    within("payload", 1, lambda: abs(receive.getPayload() - 1.5) < 1e-6)

    outputs = rtde_io.RTDEIOInterface(address)
    outputs.setStandardDigitalOut(2, True)
    outputs.setToolDigitalOut(1, True)
    within("outputs", 1, lambda: receive.getActualDigitalOutputBits() == 1 << 2 | 1 << 17)
    outputs.setAnalogOutputVoltage(0, 0.5)
    within("analog output", 1, lambda: abs(receive.getStandardAnalogOutput0() - 5.0) < 1e-6)

    control.stopScript()
    within("the end of its program", 3, lambda: not dashboard.running())
    control.disconnect()
    print("all is as it says")


def again(address):
    """Clients that end without a word leave their program behind; the next ones replace it. Commands that the emulated
    controller does not carry out fail."""
    import os

    import rtde_control
    import rtde_receive

    power_on(address)
    receive = rtde_receive.RTDEReceiveInterface(address)
    for turn in range(4):
        child = os.fork()
        if child == 0:
            os._exit(0 if tried(lambda: rtde_control.RTDEControlInterface(address).isProgramRunning()) else 1)
        check(f"client {turn}", os.waitpid(child, 0)[1] == 0)
    control = rtde_control.RTDEControlInterface(address)
    here = receive.getActualQ()
    goal = [here[0] + 0.05, *here[1:]]
    check("moveJ after them", control.moveJ(goal, 1.0, 2.0) and near(receive.getActualQ(), goal))

    commands = [
        ("setTcp", lambda control: control.setTcp([0, 0, 0.1, 0, 0, 0])),
        ("zeroFtSensor", lambda control: control.zeroFtSensor()),
        ("a pose out of reach", lambda control: control.moveL([3, 0, 0, 0, 0, 0], 0.2, 0.5)),
        ("positions out of range", lambda control: control.moveJ([9] * 6, 1.0, 2.0)),
    ]
    for name, act in commands:
        check(f"its program runs before {name}", control.isProgramRunning())
        check(f"{name} fails", not tried(partial(act, control)))
        # A new client clears the command that is left in the register.
        control.disconnect()
        control = rtde_control.RTDEControlInterface(address)
    check("moveJ after those", control.moveJ(here, 1.0, 2.0) and near(receive.getActualQ(), here))
    print("all is as it says")


def tried(act):
    """Whether it says that it was done."""
    try:
        return act()
    except Exception:
        return False


def serve(address, sent):
    """Passes a connection on, and keeps what its client sends."""
    server = socket.create_server((PROXY, 30004))
    server.settimeout(20)
    sent.put(b"")
    client, _ = server.accept()
    robot = socket.create_connection((address, 30004))
    end = time.time() + 3
    client.settimeout(0.002)
    robot.settimeout(0.002)
    while time.time() < end:
        for source, target, keep in [(client, robot, True), (robot, client, False)]:
            try:
                data = source.recv(4096)
            except TimeoutError:
                continue
            except OSError:
                return
            if not data:
                return
            if keep:
                sent.put(data)
            try:
                target.sendall(data)
            except OSError:
                return


def packets(address):
    sent: multiprocessing.Queue[bytes] = multiprocessing.Queue()
    server = multiprocessing.Process(target=serve, args=(address, sent))
    server.start()
    sent.get(timeout=10)
    code = (
        "import rtde_receive, sys\n"
        f"r = rtde_receive.RTDEReceiveInterface('{PROXY}', 125.0, ['timestamp', 'actual_q', 'robot_mode'])\n"
        "assert len(r.getActualQ()) == 6\n"
        "r.disconnect()\n"
    )
    import subprocess

    subprocess.run([sys.executable, "-c", code], check=True, timeout=20)
    data = b""
    while not sent.empty() or server.is_alive():
        try:
            data += sent.get(timeout=0.2)
        except Exception:
            continue
    server.join()
    while data:
        length = int.from_bytes(data[:2], "big")
        print(data[:length].hex())
        data = data[length:]


{"use": use, "bytes": packets, "again": again}[sys.argv[1]](sys.argv[2])
