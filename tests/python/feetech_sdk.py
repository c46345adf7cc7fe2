"""Feetech's own SDK on a line of emulated servos: feetech_sdk.py PATH. Or, with `frames`, prints the bytes of the
instructions that the adapter sends, one in hexadecimal a line."""

import sys
import time

import scservo_sdk as sdk

IDS = range(1, 7)


class Line:
    """A port that keeps what is written to it."""

    def __init__(self):
        self.is_using, self.written = False, b""

    def clearPort(self):
        pass

    def writePort(self, packet):
        self.written += bytes(packet)
        return len(packet)

    def setPacketTimeout(self, *_):
        pass

    def __getattr__(self, name):
        return lambda *_: 0


def frames():
    def sent(call):
        line = Line()
        call(line, sdk.PacketHandler(0))
        print(line.written.hex())

    sent(lambda line, packets: packets.txPacket(line, [0, 0, 1, 2, sdk.INST_PING, 0]))
    sent(lambda line, packets: packets.readTx(line, 3, 9, 4))
    for span in [(40, 31), (56, 2)]:
        sent(lambda line, packets, span=span: packets.syncReadTx(line, *span, list(IDS), len(IDS)))
    goals = [100 * i for i in IDS]
    values = [byte for i, goal in zip(IDS, goals) for byte in (i, goal & 0xFF, goal >> 8)]
    sent(lambda line, packets: packets.syncWriteTxOnly(line, 42, 2, values, len(values)))


def check(what, holds):
    if not holds:
        sys.exit(f"wrong: {what}")


class Patient(sdk.PortHandler):
    """The SDK waits 34 ms for an answer; the emulator's thread may have to wait longer for a busy processor."""

    def setPacketTimeout(self, length):
        super().setPacketTimeout(length)
        self.packet_timeout += 1000


def use(path):
    port, packets = Patient(path), sdk.PacketHandler(0)
    check("open", port.openPort() and port.setBaudRate(1_000_000))
    for servo in IDS:
        model, result, error = packets.ping(port, servo)
        check(f"ping {servo}: {model} {result} {error}", (model, result, error) == (777, sdk.COMM_SUCCESS, 0))
    check("an absent servo is silent", packets.ping(port, 9)[1] == sdk.COMM_RX_TIMEOUT)

    def all_of(address, length):
        group = sdk.GroupSyncRead(port, packets, address, length)
        for servo in IDS:
            group.addParam(servo)
        check("sync read", group.txRxPacket() == sdk.COMM_SUCCESS)
        return [group.getData(servo, address, length) for servo in IDS]

    start = all_of(56, 2)
    check(f"positions {start}", all(700 < position < 3900 for position in start))
    # The goal is where the servo is before its motor comes on.
    for servo, position in zip(IDS, start):
        check("goal", packets.write2ByteTxRx(port, servo, 42, position) == (sdk.COMM_SUCCESS, 0))
        check("torque", packets.write1ByteTxRx(port, servo, 40, 1) == (sdk.COMM_SUCCESS, 0))
    time.sleep(0.2)
    check("nothing moved", all_of(56, 2) == start)
    check("torque is on", all_of(40, 1) == [1] * 6)

    goals = [position + 60 * (1 if servo % 2 else -1) for servo, position in zip(IDS, start)]
    group = sdk.GroupSyncWrite(port, packets, 42, 2)
    for servo, goal in zip(IDS, goals):
        group.addParam(servo, [goal & 0xFF, goal >> 8])
    check("sync write", group.txPacket() == sdk.COMM_SUCCESS)
    moved, end = False, time.time() + 5
    while all_of(56, 2) != goals and time.time() < end:
        moved = moved or 1 in all_of(66, 1)
    check(f"it arrived at {goals}: {all_of(56, 2)}", all_of(56, 2) == goals and moved)

    # A write that waits for `action`, and registers that cannot be written.
    packets.regWriteTxRx(port, 2, 42, 2, [goals[1] + 40 & 0xFF, goals[1] + 40 >> 8])
    check("it waits", packets.read1ByteTxRx(port, 2, 64)[0] == 1)
    packets.action(port, sdk.BROADCAST_ID)
    time.sleep(0.5)
    check("it acts", packets.read2ByteTxRx(port, 2, 56)[0] == goals[1] + 40)
    packets.write2ByteTxRx(port, 2, 56, 5)
    check("read-only", packets.read2ByteTxRx(port, 2, 56)[0] == goals[1] + 40)
    for servo in IDS:
        packets.write1ByteTxRx(port, servo, 40, 0)
    check("torque is off", all_of(40, 1) == [0] * 6)
    port.closePort()
    print("all is as it says")


frames() if sys.argv[1] == "frames" else use(sys.argv[1])
