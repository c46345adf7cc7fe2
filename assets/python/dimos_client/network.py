"""A run on another computer (docs/many-machines.md): needs `pip install eclipse-zenoh`, and nothing else does."""

from __future__ import annotations

import atexit
import importlib
import json
import os
import socket
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any, Optional

from .errors import ConnectionLost, NoRun

BEAT = 0.1  # s between signs of life
LISTED = 0.6  # s to list the runs of a place
ANSWERED = 11.0  # s for an answer of the run, whose own limit is 10 s
OWN = 1 << 32  # numbers of the subscriptions that are served here; a run's own are below
CLASSES = {
    "read": "status state text_log motion going planner planning preview world grip arm_io arm_payload arm_tool "
    "poses robot_description transforms subscribe unsubscribe",
    "end": "stop cancel",
    "plan": "plan ik world_add world_move world_remove attach detach register_planner planner_answer",
    "move": "lease release go move move_native execute execute_plan servo velocity chunk twist pose start gripper "
    "speed arm_disable arm_io_set arm_payload_set arm_tare arm_tool_set pose_save pose_remove",
    "enable": "arm_reset arm_enable arm_teach arm_take_over",
    "own": "shutdown",
}
CLASS_OF = {method: name for name, methods in CLASSES.items() for method in methods.split()}


def connect(place: str, run: Optional[str], user: Optional[str], identity: Optional[str]) -> socket.socket:
    """A socket that leads to the run's; what is behind it ends when it is closed."""
    # On two threads that send and receive, its connections with certificates break now and then (1.10.2).
    os.environ.setdefault("ZENOH_RUNTIME", "(rx: (worker_threads: 1), tx: (handover: rx))")
    try:
        zenoh: Any = importlib.import_module("zenoh")
    except ImportError:
        raise ConnectionLost(
            "UNSUPPORTED", "a run on another computer needs zenoh", "pip install eclipse-zenoh"
        ) from None
    settings, user = _settings(place, user, identity)
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        hint = "is `dimos share` running there? do both certificates come from one authority?"
        raise ConnectionLost("UNREACHABLE", f"{place}: {error}", hint) from None
    found = session.liveliness().get("dimos/*/alive", timeout=LISTED)
    runs = sorted(str(reply.ok.key_expr).split("/")[1] for reply in found if reply.ok is not None)
    if run not in (None, *runs) or (len(runs) != 1 and run is None):
        session.close()
        named = f"shares {', '.join(runs)}" if runs else f"shares no run with {user}"
        raise NoRun("SEVERAL_RUNS" if runs and run is None else "NO_RUN", f"{place} {named}", "say which run")
    ours, theirs = socket.socketpair()
    _Line(zenoh, session, theirs, run or runs[0], user)
    return ours


def _settings(place: str, user: Optional[str], identity: Optional[str]) -> tuple[dict[str, Any], str]:
    settings: dict[str, Any] = {
        "mode": "client",
        "connect/endpoints": [place],
        "connect/timeout_ms": 2000,
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": 1000,
        "transport/link/rx/max_message_size": 16 << 20,
    }
    if not place.startswith("tls/"):
        return settings, "-"
    folder = Path(identity or os.environ.get("DIMOS_IDENTITY") or Path.home() / ".config/dimos/identity")
    keys = [key.stem for key in folder.glob("*.key")]
    if user is None and len(keys) != 1:
        raise ConnectionLost("UNREACHABLE", f"{folder} has {len(keys)} private keys", "say which: user=NAME")
    name = user or keys[0]
    files = {
        "root_ca_certificate": "ca.pem",
        "connect_certificate": f"{name}.pem",
        "connect_private_key": f"{name}.key",
    }
    settings.update({f"transport/link/tls/{key}": str(folder / file) for key, file in files.items()})
    settings["transport/link/tls/enable_mtls"] = True
    return settings, name


class _Line:
    """Passes lines on between a socket and the network, in threads that end with either."""

    def __init__(self, zenoh: Any, session: Any, line: socket.socket, run: str, user: str) -> None:
        self.zenoh, self.session, self.line, self.place = zenoh, session, line, f"run {run}"
        self.root, self.id = f"dimos/{run}", str(session.zid())
        self.own = f"{self.root}/by/{user}"
        self.proof = os.urandom(16)  # another program of the same user cannot speak for this one
        self.lock, self.ended = threading.Lock(), threading.Event()
        self.subscribers: list[Any] = []
        self.alive = session.liveliness().declare_subscriber(f"{self.root}/alive", self._gateway)
        self.thinned = session.declare_subscriber(
            f"{self.root}/to/{user}/{self.id}/*", lambda sample: self._out(sample.payload.to_bytes() + b"\n")
        )
        self.token = session.liveliness().declare_token(f"{self.own}/client/{self.id}")
        self.threads = [threading.Thread(target=task, daemon=True) for task in (self._beats, self._requests)]
        for thread in self.threads:
            thread.start()
        # zenoh's threads keep the interpreter from ending, so this must come before it waits for threads.
        getattr(threading, "_register_atexit", atexit.register)(self._end)

    def _end(self) -> None:
        """Closes the session before the interpreter ends: a callback must not come after that."""
        self.ended.set()
        with suppress(OSError):  # closed already
            self.line.shutdown(socket.SHUT_RDWR)
        for thread in self.threads:
            thread.join(2.0)

    def _gateway(self, sample: Any) -> None:
        if sample.kind == self.zenoh.SampleKind.DELETE:
            self._error(
                None,
                "LOST",
                f"the connection to {self.place} is lost",
                "it may still do what was asked: ask for status",
            )
            self.ended.set()
            self.line.shutdown(socket.SHUT_RDWR)

    def _beats(self) -> None:
        name = f"{Path(sys.argv[0]).name or 'python'} on {socket.gethostname()}"
        while not self.ended.is_set():
            self.session.put(f"{self.own}/client/{self.id}/beat", name, attachment=self.proof)
            self.ended.wait(BEAT)

    def _requests(self) -> None:
        try:
            for line in self.line.makefile("rb"):
                self._ask(json.loads(line))
        except (OSError, ValueError):
            pass
        self.ended.set()
        self.threads[0].join()
        self.session.close()
        self.line.close()

    def _ask(self, request: dict[str, Any]) -> None:
        number, method, params = request["id"], request["method"], request["params"]
        if method == "subscribe" and "rate" not in params:
            return self._subscribe(number, params["stream"])
        if method == "unsubscribe" and params["subscription"] >= OWN:
            self.subscribers[params["subscription"] - OWN].undeclare()
            return self._say({"id": number, "result": {}})
        key = f"{self.own}/{CLASS_OF.get(method, 'read')}/{self.id}/{method}"
        replies = self.session.get(key, payload=json.dumps(params), timeout=ANSWERED, attachment=self.proof)
        threading.Thread(target=self._answer, args=(number, method, replies), daemon=True).start()

    def _answer(self, number: int, method: str, replies: Any) -> None:
        for reply in replies:
            if reply.ok is not None:
                return self._say({"id": number, "result": json.loads(reply.ok.payload.to_string())})
            if "dimos-error" in str(reply.err.encoding):
                return self._say({"id": number, "error": json.loads(reply.err.payload.to_string())})
        self._error(number, "NO_ANSWER", f"{self.place} did not answer {method!r}", "`dimos status` may say why")

    def _subscribe(self, number: int, stream: str) -> None:
        subscription, expected = OWN + len(self.subscribers), [0]

        def note(sample: Any) -> None:
            message = json.loads(sample.payload.to_string())
            lost = max(message["seq"] - expected[0], 0) if expected[0] else 0
            expected[0] = message["seq"] + 1
            self._say({"stream": stream, "subscription": subscription, "lost": lost, "data": message["data"]})

        self.subscribers.append(self.session.declare_subscriber(f"{self.root}/stream/{stream}", note))
        self._say({"id": number, "result": {"subscription": subscription}})

    def _error(self, number: Optional[int], code: str, message: str, hint: str) -> None:
        self._say({"id": number, "error": {"code": code, "message": message, "hint": hint}})

    def _say(self, message: dict[str, Any]) -> None:
        self._out(json.dumps(message).encode() + b"\n")

    def _out(self, line: bytes) -> None:
        try:
            with self.lock:
                self.line.sendall(line)
        except OSError:  # the client has closed its end
            self.ended.set()
