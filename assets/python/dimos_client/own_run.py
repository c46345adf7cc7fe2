"""A run that a program starts for itself."""

from __future__ import annotations

import atexit
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterable
from contextlib import suppress
from typing import Any, Optional

from .client import Client
from .errors import ConnectionLost, DimosError, NoRun

_ENDS = 35.0  # s for a run to end; an arm may move to its park pose before


class OwnRun(Client):
    """A client of a run that ends with `close`, at the latest with this program."""

    def __init__(self, up: dict[str, Any], keep: bool, timeout: float) -> None:
        """Connects to a run, as `dimos run -d --json` reports it."""
        self.name, self.pid, self._keep, self._owner = str(up["run"]), int(up["pid"]), keep, os.getpid()
        super().__init__(up["socket"], timeout)
        atexit.register(self.close)

    def close(self) -> None:
        """Ends the connection and, unless it is kept, the run: the arms decelerate to rest. Waits for that."""
        atexit.unregister(self.close)
        # A fork of this program has a copy of the client, and the run is not its own.
        if self._socket.fileno() >= 0 and not self._keep and os.getpid() == self._owner:
            with suppress(DimosError):  # it has ended already
                self.call("shutdown")
            _await_end(self.pid)
        super().close()


def run(
    blueprint: str,
    *,
    sim: bool = True,
    set: Iterable[str] = (),
    name: Optional[str] = None,
    keep: bool = False,
    timeout: float = 15.0,
) -> OwnRun:
    """Starts a run of a blueprint, a name or a file, and returns a client of it when its arms are up. All arms are
    emulated unless `sim` is False. `set`: changes of the blueprint, "coordinator.tick_rate=250". The run ends with the
    client, by `close` or the end of `with`, and with this program however that ends, by SIGKILL too; `keep` lets it
    live on. The program is $DIMOS, or `dimos` on the PATH. `timeout` [s] is that of the client."""
    program = os.environ.get("DIMOS") or shutil.which("dimos")
    if program is None:
        raise NoRun("NO_PROGRAM", "there is no program `dimos` on the PATH", "set DIMOS to its path")
    command = [program, "run", "--daemon", "--json"]
    command += ["--sim"] * sim + [f"--set={change}" for change in set] + [f"--name={name}"] * (name is not None)
    command += [] if keep else [f"--end-with={os.getpid()}"]
    try:
        done = subprocess.run([*command, "--", blueprint], stdin=subprocess.DEVNULL, capture_output=True, text=True)
    except OSError as error:
        raise NoRun("NO_PROGRAM", f"cannot start {program}: {error}", "set DIMOS to the path of dimos") from None
    up: Optional[dict[str, Any]] = json.loads(done.stdout) if done.stdout.strip() else None
    if done.returncode or up is None:
        if up is not None and not keep:  # it is up, but an arm is held
            with suppress(DimosError):
                OwnRun(up, False, timeout).close()
        raise _failure(done.stderr, done.returncode)
    return OwnRun(up, keep, timeout)


def _failure(said: str, code: int) -> DimosError:
    """The error on the last line of stderr, with what is above it: mistakes of the blueprint, warnings."""
    *before, last = said.strip().splitlines() or [f"it ended with exit code {code}"]
    try:
        error = json.loads(last)["error"]
    except (ValueError, KeyError, TypeError):
        error = {"code": "NOT_STARTED", "message": last}
    return NoRun(error["code"], "\n".join([error["message"], *before]), error.get("hint"), error.get("data"))


def _await_end(pid: int) -> None:
    """Waits for the end of a process that is no child."""
    deadline = time.monotonic() + _ENDS
    try:
        process = os.pidfd_open(pid)
    except OSError:  # it has ended
        return
    try:
        if not select.select([process], [], [], deadline - time.monotonic())[0]:
            raise ConnectionLost("NO_ANSWER", f"the run (pid {pid}) has not ended within {_ENDS:g} s", "dimos logs")
    finally:
        os.close(process)
