"""Carries out the program that the adapter sends to a controller of Universal Robots: without its lines `end` it is
Python. The question has its text, the time of a step, the registers that each step finds, and the joint positions at
the beginning; the answer is what each step ordered, and the state that it wrote."""

import json
import math
import sys
from contextlib import suppress
from typing import Any


class Over(Exception):
    """The steps are over."""


def run(text, step, steps, target):
    ordered: list[Any] = []
    out: dict[int, Any] = {}
    position, reads = 0, 0

    def read(kind):
        def register(number):
            nonlocal reads
            reads += 1
            # A step may find registers that change between its reads.
            now = steps[position]
            if "after" in now and reads > now["after"]:
                now = now["then"]
            return now[kind][number - 24]

        return register

    def passes(name):
        def act(*values):
            nonlocal position, reads
            ordered.append([name, [list(v) if isinstance(v, list) else v for v in values], out.get(25), out.get(24)])
            reads = 0
            position += 1
            if position >= len(steps):
                raise Over

        return act

    names = {
        "get_steptime": lambda: step,
        "get_target_joint_positions": lambda: list(target),
        "floor": math.floor,
        "read_input_integer_register": read("int"),
        "read_input_float_register": read("double"),
        "write_output_integer_register": out.__setitem__,
        "servoj": passes("servoj"),
        "speedj": passes("speedj"),
        "sync": passes("sync"),
        "stopj": lambda deceleration: ordered.append(["stopj", [deceleration], out.get(25), out.get(24)]),
    }
    lines = [line for line in text.splitlines() if line.strip() != "end"]
    exec("\n".join(lines), names)
    with suppress(Over):
        names["dimos_control"]()
    return {"ordered": ordered, "out": {str(n): value for n, value in out.items()}}


question = json.load(sys.stdin)
print(json.dumps(run(question["text"], question["step"], question["steps"], question["target"])))
