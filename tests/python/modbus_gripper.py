"""A gripper with Robotiq's registers on pymodbus's server: on a serial line, or on Modbus TCP. Its fingers are at once
where they are sent; sent to close, they find something at 100.

modbus_gripper.py rtu|tcp
"""

import asyncio
import os
import pty
import socket
import sys
import threading
import tty

from pymodbus.framer import FramerType
from pymodbus.server import StartAsyncSerialServer, StartAsyncTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

FIRST, ACTION, STATUS, LAST = 1000, 1000, 2000, 2002


async def act(_function, start, address, _count, registers, values):
    """Changes the status as the written registers ask."""
    if values is None:
        return None
    for offset, value in enumerate(values):
        registers[address + offset - start] = value
    action, position, _ = registers[ACTION - start : ACTION - start + 3]
    active, goes = action >> 8 & 1, action >> 11 & 1
    at, fingers = registers[STATUS + 2 - start] >> 8, 0
    if goes:
        wanted = position & 0xFF
        at, fingers = (100, 2) if wanted > 200 else (wanted, 3)
    state = active | goes << 3 | (3 if active else 0) << 4 | fingers << 6
    registers[STATUS - start : STATUS - start + 3] = [state << 8, position & 0xFF, at << 8]
    return None


def line():
    """Two pseudo-terminals with a wire between them."""
    ends = [pty.openpty() for _ in range(2)]
    for near, far in ends:
        tty.setraw(near)
        tty.setraw(far)

    def carry(source, sink):
        while True:
            os.write(sink, os.read(source, 256))

    for source, sink in ((ends[0][0], ends[1][0]), (ends[1][0], ends[0][0])):
        threading.Thread(target=carry, args=(source, sink), daemon=True).start()
    return [os.ttyname(far) for _, far in ends]


async def main(kind):
    registers = SimData(FIRST, values=[0] * (LAST - FIRST + 1), datatype=DataType.REGISTERS)
    device = SimDevice(9, simdata=[registers], action=act)
    if kind == "tcp":
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        print(f"tcp:127.0.0.1:{port}", flush=True)
        await StartAsyncTcpServer(device, address=("127.0.0.1", port))
    else:
        ours, theirs = line()
        print(theirs, flush=True)
        await StartAsyncSerialServer(device, framer=FramerType.RTU, port=ours, baudrate=115200)


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1]))
