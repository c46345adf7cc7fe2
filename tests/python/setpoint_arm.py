"""The simulated arm of sim_arm.py with an SDK that takes setpoints with torques. What it gets is written to RECORD."""

from __future__ import annotations

import json
import os
from typing import Any

from sim_arm import SimArmAdapter


class SetpointArmAdapter(SimArmAdapter):
    effort_kind = "from_current"

    def write_setpoint(
        self, position: Any, velocity: Any = None, effort: Any = None, at: Any = None, expires: Any = None
    ) -> bool:
        got = {"position": position, "velocity": velocity, "effort": effort, "at": at, "expires": expires}
        with open(os.environ["RECORD"], "a") as record:
            record.write(json.dumps(got) + "\n")
        return self.write_joint_positions(position, 1.0)

    def missing_joints(self) -> list[int]:
        lost = os.environ["RECORD"] + ".lost"
        return [int(open(lost).read())] if os.path.exists(lost) else []

    def read_device_time(self) -> int:
        return 1_250_000_000
