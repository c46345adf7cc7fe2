"""A run as the `ControlCoordinator` of Python dimos 0.0.15, for its clients and planners on this computer.

`python3 -m dimos_client.python_dimos --run NAME --command`. Needs Python dimos itself, whose bus and messages it uses
(pip install dimos==0.0.15). It is a client of the run like any other, in its own process: stopped, or with another
coordinator of that name on the bus, it ends, and what it has begun is cancelled.
"""

# mypy: disable-error-code="import-untyped"
from __future__ import annotations

import argparse
import io
import os
import pickle
import sys
import threading
import time
from collections.abc import Sequence
from typing import Any, Optional

import zenoh
from dimos.core.global_config import global_config
from dimos.core.transport_factory import make_transport
from dimos.msgs.sensor_msgs.JointState import JointState
from dimos.protocol.rpc.rpc_utils import serialize_exception
from dimos.protocol.rpc.zenohrpc import EXCEPTION_ENCODING, ZenohRPC

from .client import Client
from .errors import DimosError
from .python_dimos_calls import Coordinator

MAX_BYTES = 16 << 20  # of a call
SEARCH_PERIOD, ANSWER_TIMEOUT = 5.0, 0.3  # s, of the search for another coordinator
CLASSES = {  # what a call may contain: planners put the numbers of numpy into lists
    ("dimos.msgs.trajectory_msgs.JointTrajectory", "JointTrajectory"),
    ("dimos.msgs.trajectory_msgs.TrajectoryPoint", "TrajectoryPoint"),
    ("numpy", "dtype"),
    ("numpy.core.multiarray", "scalar"),
    ("numpy._core.multiarray", "scalar"),
}
# Methods that pass live Python objects, or change what is the blueprint's.
UNSUPPORTED = (
    "add_hardware",
    "add_task",
    "get_stream_descriptors",
    "get_task",
    "peek_stream",
    "remove_hardware",
    "remove_task",
    "set_activated",
    "set_dry_run",
    "set_module_ref",
    "set_transport",
)


class Reader(pickle.Unpickler):
    """Reads a call without executing what it names."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in CLASSES:
            raise TypeError(f"{module}.{name} is not part of a call")
        return super().find_class(module, name)


def arguments(payload: bytes) -> tuple[Sequence[Any], dict[str, Any]]:
    """The arguments of a call."""
    if len(payload) > MAX_BYTES:
        raise TypeError(f"the call has {len(payload)} bytes (limit {MAX_BYTES})")
    try:
        positional, named = Reader(io.BytesIO(payload)).load()
        return list(positional), dict(named)
    except TypeError:
        raise
    except Exception as error:
        raise TypeError(f"the payload is no pair of arguments and named arguments: {error}") from None


class Server:
    """The coordinator on the bus of Python dimos."""

    def __init__(self, coordinator: Coordinator, name: str) -> None:
        self.coordinator, self.name, self.rpc = coordinator, name, ZenohRPC()
        self.rpc.start()

    def other(self) -> Optional[str]:
        """The arms of another coordinator of this name, in words."""
        found: list[str] = []
        deadline = time.monotonic() + ANSWER_TIMEOUT
        while not found and (left := deadline - time.monotonic()) > 0:
            done = threading.Event()

            def answer(reply: Any) -> None:
                if reply.ok is not None:
                    try:
                        arms = Reader(io.BytesIO(reply.ok.payload.to_bytes())).load()
                        found.append(" with " + ", ".join(str(arm)[:40] for arm in arms[:8]) if arms else "")
                    except Exception:
                        found.append("")
                elif str(reply.err.encoding).startswith("dimos/"):
                    found.append("")

            handler = zenoh.handlers.Callback(answer, drop=done.set)
            self.rpc.session.get(
                f"dimos/rpc/{self.name}/list_hardware",
                handler,
                payload=pickle.dumps(([], {})),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=left,
                allowed_destination=zenoh.Locality.REMOTE,
            )
            done.wait(left)
            time.sleep(0.05)
        return found[0] if found else None

    def serve(self) -> None:
        pool = self.rpc._get_call_thread_pool()

        def receive(query: Any) -> None:
            method = str(query.key_expr).rsplit("/", 1)[-1]
            if "*" not in method and "$" not in method:  # one with wildcards is no call
                pool.submit(self.answer, method, query)

        self.queryable = self.rpc.session.declare_queryable(f"dimos/rpc/{self.name}/*", receive, complete=True)

    def answer(self, method: str, query: Any) -> None:
        silent = query.attachment is not None
        try:
            if method in UNSUPPORTED:
                raise NotImplementedError(
                    f"{self.name} is a run of the dimos binary: it has no {method}(); its "
                    "blueprint has the arms and the tasks"
                )
            if method.startswith("_") or method == "free_lease" or not callable(getattr(Coordinator, method, None)):
                raise AttributeError(f"'{self.name}' object has no attribute '{method[:80]}'")
            positional, named = arguments(query.payload.to_bytes() if query.payload else b"")
            value = getattr(self.coordinator, method)(*positional, **named)
            if not silent:
                query.reply(query.key_expr, pickle.dumps(value))
        except Exception as error:
            if isinstance(error, DimosError):
                error = RuntimeError(str(error))
            if not silent:
                query.reply_err(pickle.dumps(serialize_exception(error)), encoding=EXCEPTION_ENCODING)
        query.drop()

    def publish(self, client: Client, ended: threading.Event) -> None:
        """Publishes the run's joint states; ends with the run."""
        transport, theirs = make_transport("coordinator_joint_state", JointState), self.coordinator.names.theirs
        try:
            for state in client.joint_states():
                # Python dimos leaves out joints whose positions are unknown, and lists that are not complete.
                known = [at for at, position in enumerate(state.position) if position is not None]
                rest = [[values[at] for at in known] for values in (state.velocity, state.effort)]
                velocity, effort = (values if None not in values else [] for values in rest)
                message = JointState(
                    ts=state.stamp,
                    frame_id="coordinator",
                    name=[theirs[state.name[at]] for at in known],
                    position=[state.position[at] for at in known],
                    velocity=velocity,
                    effort=effort,
                )
                message.tick = state.tick
                self.coordinator.newest = (time.monotonic(), message)
                transport.broadcast(None, message)
        except DimosError as error:
            print(f"the run is gone: {error}", file=sys.stderr)
        ended.set()


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python3 -m dimos_client.python_dimos", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--run", help="the run, if several are live")
    parser.add_argument("--at", metavar="PLACE", help="a run on another computer: tls/HOST:PORT")
    parser.add_argument("--user", help="the user of the certificate, with --at")
    parser.add_argument("--identity", metavar="DIR", help="folder of the certificates, with --at")
    parser.add_argument("--name", default="ControlCoordinator", help="name of the coordinator")
    parser.add_argument("--command", action="store_true", help="EVERY PROGRAM ON THIS COMPUTER MAY MOVE THE ARMS")
    parser.add_argument("--domain", default="", help="domain of the streams: --zenoh-domain of Python dimos")
    parser.add_argument("--joint", action="append", default=[], metavar="OURS=THEIRS", help="name of a joint")
    given = parser.parse_args()
    if given.domain:
        global_config.update(zenoh_domain=given.domain)

    def connect(commands: bool) -> Client:
        if given.at:
            return Client.at(given.at, given.run, given.user, given.identity)
        client = Client.connect(given.run)
        if commands:
            client.call("on_behalf_of", client="Python dimos", cancel_at_end=True)
        return client

    ended = threading.Event()
    try:
        coordinator = Coordinator(connect, dict(joint.split("=", 1) for joint in given.joint), given.command)
        states = connect(False)
    except DimosError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    server = Server(coordinator, given.name)

    def other() -> bool:
        if (arms := server.other()) is not None:
            print(
                f"error: another {given.name}{arms} is on the bus of Python dimos; both would move\n"
                "hint: end that one, then start this again; or give this one another name: --name",
                file=sys.stderr,
            )
        return arms is not None

    if other():
        return 1
    threading.Thread(target=server.publish, args=(states, ended), daemon=True).start()
    while coordinator.newest is None and not ended.wait(0.01):
        pass
    server.serve()
    print(
        f"the run is {given.name} of Python dimos on this computer: it reads, and ends motion"
        + ("; EVERY PROGRAM ON THIS COMPUTER MAY MOVE THE ARMS" if given.command else ""),
        flush=True,
    )
    search = time.monotonic()
    found = False
    try:
        while not found and not ended.wait(0.1):
            coordinator.free_lease()
            if time.monotonic() - search > SEARCH_PERIOD - ANSWER_TIMEOUT:
                found, search = other(), time.monotonic()
    except KeyboardInterrupt:
        pass
    server.queryable.undeclare()
    coordinator.moves.close()
    return 1 if found else 0


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    os._exit(code)  # threads of the bus may outlive their session
