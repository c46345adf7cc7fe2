"""An arm whose vendor gives a Python SDK in degrees, and its adapter in the form of the guide's skeleton.

The SDK plays the arm itself, so that nothing is needed to try it. SIGUSR1 puts it into error 2; ROUND_TRIP in the
environment is how long each call of the SDK takes [s]; TROUBLE names a method that goes wrong.
"""

from __future__ import annotations

import math
import os
import signal
import time

from dimos.hardware.manipulators.spec import ControlMode, JointLimits, ManipulatorInfo

TROUBLE = os.environ.get("TROUBLE", "")


class SimSDK:
    """What a vendor ships. Units: degrees, degrees per second."""

    SPEED, ACCELERATION = 180.0, 2000.0

    def __init__(self, address: str, dof: int) -> None:
        self.round_trip, self.dof = float(os.environ.get("ROUND_TRIP", "0")), dof
        self.q, self.v, self.target, self.speed = [0.0] * dof, [0.0] * dof, [0.0] * dof, self.SPEED
        self.mode, self.on, self.error, self.at = 0, False, 0, time.monotonic()
        signal.signal(signal.SIGUSR1, lambda *_: setattr(self, "error", 2))

    def step(self) -> None:
        """Moves the joints up to now, as a controller does all the time."""
        time.sleep(self.round_trip)
        now = time.monotonic()
        steps = min(int((now - self.at) / 0.002), 500)
        self.at = self.at + 0.002 * steps if steps < 500 else now
        for _ in range(steps):
            for i in range(self.dof):
                gap = self.target[i] - self.q[i]
                wanted = (
                    self.target[i]
                    if self.mode == 4
                    else math.copysign(
                        min(math.sqrt(2 * 0.8 * self.ACCELERATION * abs(gap)), self.speed, abs(gap) / 0.002), gap
                    )
                )
                wanted = wanted if self.on and not self.error else 0.0
                most = self.ACCELERATION * 0.002
                self.v[i] += max(-most, min(most, wanted - self.v[i]))
                self.q[i] += self.v[i] * 0.002

    def halt(self) -> None:
        self.step()
        brake = [v * abs(v) / (2 * 0.8 * self.ACCELERATION) for v in self.v]
        self.target = [0.0] * self.dof if self.mode == 4 else [q + b for q, b in zip(self.q, brake)]

    def set_mode(self, mode: int) -> bool:
        self.halt()
        self.mode = mode
        self.halt()
        return True

    def move(self, target: list[float], speed: float) -> bool:
        self.step()
        if not self.on or self.error or len(target) != self.dof:
            return False
        self.target, self.speed = target, speed
        return True

    def enable(self, on: bool) -> bool:
        self.halt()
        self.on = on and not self.error
        return self.on == on

    def clear(self) -> bool:
        self.halt()
        self.error = 0
        return True


class SimArmAdapter:
    """Hardware adapter. SDK units: degrees. DimOS units: radians, rad/s."""

    def __init__(self, address: str, dof: int = 6) -> None:
        if not address:
            raise ValueError("address is required for SimArmAdapter")
        self._address = address
        self._dof = dof
        self._sdk: SimSDK | None = None
        self._control_mode: ControlMode = ControlMode.POSITION

    def connect(self) -> bool:
        self._sdk = SimSDK(self._address, self._dof)
        return TROUBLE != "connect"

    def disconnect(self) -> None:
        self._sdk = None

    def is_connected(self) -> bool:
        return self._sdk is not None

    def activate(self) -> bool:
        return self.write_enable(True)

    def deactivate(self) -> bool:
        return self.write_stop()

    def get_info(self) -> ManipulatorInfo:
        return ManipulatorInfo(
            vendor="SimVendor", model="SimArm", dof=self._dof, firmware_version="1.2", serial_number=None
        )

    def get_dof(self) -> int:
        return self._dof

    def get_limits(self) -> JointLimits:
        return JointLimits(
            position_lower=[-math.pi] * self._dof,
            position_upper=[math.pi] * self._dof,
            velocity_max=[math.pi] * self._dof,
        )

    def set_control_mode(self, mode: ControlMode) -> bool:
        if not self._sdk:
            return False
        mode_map = {ControlMode.POSITION: 0, ControlMode.SERVO_POSITION: 1, ControlMode.VELOCITY: 4}
        sdk_mode = mode_map.get(mode)
        if sdk_mode is None:
            return False
        success = self._sdk.set_mode(sdk_mode)
        if success:
            self._control_mode = mode
        return success

    def get_control_mode(self) -> ControlMode:
        return self._control_mode

    def read_joint_positions(self) -> list[float]:
        if not self._sdk:
            raise RuntimeError("Not connected")
        self._sdk.step()
        if TROUBLE == "nan":
            return [0.1, 0.2, math.nan] + [0.0] * (self._dof - 3)
        if TROUBLE == "short":
            return [0.0] * (self._dof - 1)
        return [math.radians(p) for p in self._sdk.q]

    def read_joint_velocities(self) -> list[float]:
        if not self._sdk:
            return [0.0] * self._dof
        self._sdk.step()
        if TROUBLE == "infinite":
            return [0.0, -math.inf] + [0.0] * (self._dof - 2)
        return [math.radians(v) for v in self._sdk.v]

    def read_joint_efforts(self) -> list[float]:
        return [0.0] * self._dof

    def read_state(self) -> dict[str, int]:
        if not self._sdk:
            return {"state": 0, "mode": 0}
        return {"state": int(self._sdk.on), "mode": self._sdk.mode}

    def read_error(self) -> tuple[int, str]:
        if not self._sdk:
            return 0, ""
        self._sdk.step()
        code = self._sdk.error
        return (code, f"SimArm error {code}") if code else (0, "")

    def write_joint_positions(self, positions: list[float], velocity: float = 1.0) -> bool:
        if not self._sdk:
            return False
        return self._sdk.move([math.degrees(p) for p in positions], velocity * self._sdk.SPEED)

    def write_joint_velocities(self, velocities: list[float]) -> bool:
        if not self._sdk:
            return False
        return self._sdk.move([math.degrees(v) for v in velocities], self._sdk.SPEED)

    def write_stop(self) -> bool:
        if not self._sdk:
            return False
        self._sdk.halt()
        return TROUBLE != "write_stop"

    def write_enable(self, enable: bool) -> bool:
        if not self._sdk:
            return False
        return self._sdk.enable(enable)

    def read_enabled(self) -> bool:
        if not self._sdk:
            return False
        self._sdk.step()
        return self._sdk.on and TROUBLE != "read_enabled"

    def write_clear_errors(self) -> bool:
        if not self._sdk:
            return False
        return self._sdk.clear()

    def read_cartesian_position(self) -> dict[str, float] | None:
        return None

    def write_cartesian_position(self, pose: dict[str, float], velocity: float = 1.0) -> bool:
        return False

    def read_gripper_position(self) -> float | None:
        return None

    def write_gripper_position(self, position: float) -> bool:
        return False

    def read_force_torque(self) -> list[float] | None:
        return None


def register(registry) -> None:
    registry.register("simarm", SimArmAdapter)


class RotaryGripperAdapter(SimArmAdapter):
    """The same arm with a rotary gripper."""

    gripper_unit = "rad"
    angle = 0.0

    def read_gripper_position(self) -> float | None:
        return self.angle

    def write_gripper_position(self, position: float) -> bool:
        self.angle = position
        return True


class HostileAdapter(SimArmAdapter):
    """An arm whose texts a terminal would execute."""

    HOSTILE = "\x1b]0;owned\x07\x1b[2J\u202eevil\x7f\x9b5m"

    def get_info(self) -> ManipulatorInfo:
        return ManipulatorInfo(
            vendor=self.HOSTILE,
            model=self.HOSTILE,
            dof=self._dof,
            firmware_version=self.HOSTILE,
            serial_number=self.HOSTILE,
        )

    def read_error(self) -> tuple[int, str]:
        code, _ = super().read_error()
        return code, self.HOSTILE if code else ""
