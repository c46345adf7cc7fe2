"""Errors of the client."""

from __future__ import annotations

from typing import Any, Optional


class DimosError(Exception):
    """What went wrong: `code` for programs, `message` and `hint` for people, `data` with the figures."""

    def __init__(self, code: str, message: str, hint: Optional[str] = None, data: Any = None) -> None:
        super().__init__(f"{message} [{code}]" + (f"\nhint: {hint}" if hint else ""))
        self.code, self.message, self.hint, self.data = code, message, hint, data


class NoRun(DimosError):
    """No run is live, or none of that name, or several and none was named."""


class ConnectionLost(DimosError):
    """The run ended, or does not answer."""


class Refused(DimosError):
    """The run refused a request; the codes are in docs/rpc.md."""


class LeaseHeld(Refused):
    """Another program commands the arm; `data` has its `pid` and `program`."""


class ArmNotReady(Refused):
    """The arm is held, faulted or not enabled: `reset`, then `enable`."""


class OutOfLimits(Refused):
    """A target or the way there leaves a limit; `data` has `joint` and `by`."""


class OutOfReach(Refused):
    """A streamed target is further from the one before than the joint gets in that time. It is left out, and the stream
    continues; `data` has `joint` and `by`."""


class PlanningFailed(DimosError):
    """There is no plan; `data` is the reply to `planning`."""


class MotionFailed(DimosError):
    """A motion ended elsewhere than it should; `data` is the reply to `motion`."""


_REFUSALS: dict[str, type[Refused]] = {
    "LEASE_HELD": LeaseHeld,
    "OUT_OF_LIMITS": OutOfLimits,
    "OUT_OF_REACH": OutOfReach,
    "ARM_LATCHED": ArmNotReady,
    "ARM_NOT_READY": ArmNotReady,
    "STILL_FAULTED": ArmNotReady,
}


def refusal(error: dict[str, Any]) -> Refused:
    """The exception for the `error` of a reply."""
    kind = _REFUSALS.get(error["code"], Refused)
    return kind(error["code"], error["message"], error.get("hint"), error.get("data"))
