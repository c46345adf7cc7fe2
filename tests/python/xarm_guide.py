"""XArm adapter — implements ManipulatorAdapter protocol, exactly as the guide's skeleton, around xarm-python-sdk.

SDK Units: degrees, mm
DimOS Units: angles=radians, distance=meters, velocity=rad/s
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

# Import your vendor SDK
from xarm.wrapper import XArmAPI

if TYPE_CHECKING:
    from dimos.hardware.manipulators.registry import AdapterRegistry

from dimos.hardware.manipulators.spec import (
    ControlMode,
    JointLimits,
    ManipulatorInfo,
)

TOP_SPEED = 180.0  # deg/s


class XArmAdapter:
    """XArm hardware adapter.

    Implements ManipulatorAdapter protocol via duck typing.
    No inheritance required — just match the method signatures in spec.py.
    """

    def __init__(self, address: str, dof: int = 6) -> None:
        if not address:
            raise ValueError("address is required for XArmAdapter")
        self._address = address
        self._dof = dof
        self._sdk: XArmAPI | None = None
        self._control_mode: ControlMode = ControlMode.POSITION

    def connect(self) -> bool:
        """Connect to hardware. Returns True on success."""
        try:
            self._sdk = XArmAPI(self._address)
            if not self._sdk.connected:
                print(f"ERROR: Arm at {self._address} not reachable")
                return False
            return True
        except Exception as e:
            print(f"ERROR: Failed to connect to arm at {self._address}: {e}")
            return False

    def disconnect(self) -> None:
        if self._sdk:
            self._sdk.disconnect()
            self._sdk = None

    def is_connected(self) -> bool:
        return self._sdk is not None and self._sdk.connected

    def activate(self) -> bool:
        return self.write_enable(True)

    def deactivate(self) -> bool:
        return self.write_stop()

    def get_info(self) -> ManipulatorInfo:
        return ManipulatorInfo(
            vendor="UFACTORY",
            model=f"xArm{self._dof}",
            dof=self._dof,
            firmware_version=self._sdk.version if self._sdk else None,
            serial_number=self._sdk.sn if self._sdk else None,
        )

    def get_dof(self) -> int:
        return self._dof

    def get_limits(self) -> JointLimits:
        return JointLimits(
            position_lower=[-2 * math.pi] * self._dof,
            position_upper=[2 * math.pi] * self._dof,
            velocity_max=[math.pi] * self._dof,
        )

    def set_control_mode(self, mode: ControlMode) -> bool:
        if not self._sdk:
            return False
        mode_map = {
            ControlMode.POSITION: 0,
            ControlMode.SERVO_POSITION: 1,
            ControlMode.VELOCITY: 4,
        }
        sdk_mode = mode_map.get(mode)
        if sdk_mode is None:
            return False  # Unsupported mode
        # A controller that is ready may fall back to mode 0 instead: it takes a new mode in state 4, stopped.
        success = all(
            code == 0 for code in (self._sdk.set_state(4), self._sdk.set_mode(sdk_mode), self._sdk.set_state(0))
        )
        if success:
            self._control_mode = mode
        return success

    def get_control_mode(self) -> ControlMode:
        return self._control_mode

    def read_joint_positions(self) -> list[float]:
        if not self._sdk:
            raise RuntimeError("Not connected")
        code, raw_positions = self._sdk.get_servo_angle()
        if code != 0:
            raise RuntimeError(f"get_servo_angle returns {code}")
        return [math.radians(p) for p in raw_positions[: self._dof]]

    def read_joint_velocities(self) -> list[float]:
        return [0.0] * self._dof

    def read_joint_efforts(self) -> list[float]:
        return [0.0] * self._dof

    def read_state(self) -> dict[str, int]:
        if not self._sdk:
            return {"state": 0, "mode": 0}
        return {"state": self._sdk.state, "mode": self._sdk.mode}

    def read_error(self) -> tuple[int, str]:
        if not self._sdk:
            return 0, ""
        code = self._sdk.error_code
        if code == 0:
            return 0, ""
        return code, f"XArm error {code}"

    def write_joint_positions(self, positions: list[float], velocity: float = 1.0) -> bool:
        if not self._sdk:
            return False
        angles = [math.degrees(p) for p in positions]
        if self._control_mode == ControlMode.SERVO_POSITION:
            return self._sdk.set_servo_angle_j(angles) == 0
        return self._sdk.set_servo_angle(angle=angles, speed=velocity * TOP_SPEED, wait=False) == 0

    def write_joint_velocities(self, velocities: list[float]) -> bool:
        if not self._sdk:
            return False
        return self._sdk.vc_set_joint_velocity([math.degrees(v) for v in velocities]) == 0

    def write_stop(self) -> bool:
        """Stop all motion immediately."""
        if not self._sdk:
            return False
        return self._sdk.set_state(4) == 0

    def write_enable(self, enable: bool) -> bool:
        if not self._sdk:
            return False
        if self._sdk.motion_enable(enable) != 0:
            return False
        return self.set_control_mode(self._control_mode) if enable else True

    def read_enabled(self) -> bool:
        if not self._sdk:
            return False
        return all(self._sdk.motor_enable_states[: self._dof])

    def write_clear_errors(self) -> bool:
        if not self._sdk:
            return False
        return self._sdk.clean_error() == 0

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


# ── Registry hook (required for auto-discovery) ───────────────────
def register(registry: AdapterRegistry) -> None:
    """Register this adapter with the registry."""
    registry.register("xarm", XArmAdapter)
