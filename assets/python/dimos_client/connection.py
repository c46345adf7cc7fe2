"""A connection to a run: requests, replies, subscriptions."""

from __future__ import annotations

import json
import os
import socket
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Callable, Optional, TypeVar, Union

from .errors import ConnectionLost, NoRun, Refused, refusal
from .live_runs import _address, _peer, runs

MAX_LINE = 256 * 1024  # bytes of a request
_URGENT, _FIRST, _ABSENT = 10.0, 1.0, 1.0  # s, for a stop: in all, for its first attempt, while nothing listens
_PASSING = ("NO_ANSWER", "NO_CONNECTION", "TOO_MANY_CONNECTIONS")  # a new connection may get an answer
KEPT = 256  # messages of a subscription that wait to be read; older ones are lost and counted
_Self = TypeVar("_Self", bound="Connection")


class Connection:
    """A connection to a run."""

    def __init__(self, path: Union[str, Path, socket.socket], timeout: float = 15.0) -> None:
        """Connects to a socket, or uses one. `timeout` [s] bounds every wait for the run."""
        self.timeout, self._next_id, self._unread = timeout, 0, b""
        self._path = None if isinstance(path, socket.socket) else path
        self._replies: dict[int, dict[str, Any]] = {}
        self._queues: dict[int, deque[dict[str, Any]]] = {}
        if isinstance(path, socket.socket):
            self._socket = path
            return
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.settimeout(timeout)
        try:
            self._socket.connect(_address(path))
            user = _peer(self._socket)[1]
            if os.geteuid() not in (0, user):
                raise PermissionError(f"it belongs to user {user}")
        except OSError as error:
            self._socket.close()
            raise ConnectionLost("NO_CONNECTION", f"{path}: {error}", "see `dimos status`") from None

    @classmethod
    def connect(cls: type[_Self], run: Optional[str] = None, timeout: float = 15.0) -> _Self:
        """Connects to the run of a name or, without one, to the only live run."""
        live = runs()
        if run is None and len(live) > 1:
            raise NoRun("SEVERAL_RUNS", f"several runs are live: {', '.join(live)}", "say which")
        if not live or run not in (None, *live):
            raise NoRun(
                "NO_RUN",
                f"no run of this user is live{f' by the name of {run}' if run else ''}",
                "start one: dimos run",
            )
        return cls(live[run or next(iter(live))], timeout)

    @classmethod
    def at(
        cls: type[_Self],
        place: str,
        run: Optional[str] = None,
        user: Optional[str] = None,
        identity: Optional[str] = None,
        timeout: float = 15.0,
    ) -> _Self:
        """Connects to a run on another computer: `tls/HOST:PORT`. `identity` is a folder with ca.pem and the
        certificate and key of `user`, by default the only one in it. Needs eclipse-zenoh."""
        from .network import connect

        return cls(connect(place, run, user, identity), timeout)

    def close(self) -> None:
        """Ends the connection and what it leases. A motion that has begun continues; a stream goes stale."""
        self._socket.close()

    def __enter__(self: _Self) -> _Self:
        return self

    def __exit__(
        self, kind: Optional[type[BaseException]], error: Optional[BaseException], trace: Optional[TracebackType]
    ) -> None:
        self.close()

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Any request of docs/rpc.md: its `result`. Parameters that are None are left out. Raises Refused."""
        return self._answer(self._send(method, params))

    def status(self) -> dict[str, Any]:
        """Arms, tasks, timing, recorder, as docs/rpc.md says."""
        return self.call("status")

    def _send(self, method: str, params: dict[str, Any]) -> int:
        self._next_id += 1
        params = {key: value for key, value in params.items() if value is not None}
        try:
            request = json.dumps({"id": self._next_id, "method": method, "params": params}, allow_nan=False)
        except ValueError as error:
            raise Refused("INVALID_PARAMS", f"{method}: {error}", "all numbers must be finite") from None
        if len(line := request.encode() + b"\n") > MAX_LINE:
            raise Refused("TOO_LARGE", f"the request has {len(line)} bytes, and may have {MAX_LINE}")
        try:
            self._socket.settimeout(self.timeout)
            self._socket.sendall(line)
        except OSError as error:
            raise ConnectionLost("NO_CONNECTION", f"the run is gone: {error}") from None
        return self._next_id

    def _urgent(self, method: str, **params: Any) -> dict[str, Any]:
        """A request that always gets through: over new connections where it gets no answer at once, so that it may be
        sent several times. Over a network it is sent once."""
        if self._path is None:
            return self.call(method, **params)
        began, limit, attempt = time.monotonic(), _URGENT, _FIRST
        try:
            return self._answer(self._send(method, params), min(attempt, self.timeout))
        except ConnectionLost as error:
            if error.code not in _PASSING:
                raise
        while True:
            try:
                limit = _ABSENT
                with Connection(self._path, attempt) as other:
                    limit = _URGENT
                    return other._answer(other._send(method, params))
            except ConnectionLost as error:
                if error.code not in _PASSING or time.monotonic() - began > limit:
                    raise
                attempt *= 2 if error.code == "NO_ANSWER" else 1
                time.sleep(0.02)

    def _answer(self, number: int, limit: Optional[float] = None) -> dict[str, Any]:
        limit = self.timeout if limit is None else limit
        self._await(lambda: number in self._replies, limit, "answer", "`dimos status` may say why")
        reply = self._replies.pop(number)
        if "error" in reply:
            raise refusal(reply["error"])
        result: dict[str, Any] = reply["result"]
        return result

    def _await(self, ready: Callable[[], Any], limit: float, what: str, hint: str) -> None:
        """Takes in what the run says until `ready`, at most for `limit` [s]; then raises ConnectionLost."""
        deadline = time.monotonic() + limit
        while not ready():
            if time.monotonic() > deadline or not self._read(deadline):
                raise ConnectionLost("NO_ANSWER", f"no {what} within {limit:g} s", hint)

    def _read(self, deadline: float) -> bool:
        """Takes in what the run says next; False when nothing came until `deadline` (monotonic) [s]."""
        try:
            self._socket.settimeout(max(deadline - time.monotonic(), 1e-6))
            chunk = self._socket.recv(1 << 16)
        except (socket.timeout, BlockingIOError):
            return False
        except OSError as error:
            raise ConnectionLost("NO_CONNECTION", f"the run is gone: {error}") from None
        if not chunk:
            raise ConnectionLost("NO_CONNECTION", "the run closed the connection", "it may have ended: `dimos status`")
        *lines, self._unread = (self._unread + chunk).split(b"\n")
        for message in map(json.loads, lines):
            if "stream" in message:
                self._queue(message)
            elif message["id"] is None:  # it speaks of the connection, which it closes
                reason = message["error"]
                raise ConnectionLost(reason["code"], reason["message"], reason.get("hint"))
            else:
                self._replies[message["id"]] = message
        return True

    def _queue(self, message: dict[str, Any]) -> None:
        queue = self._queues.get(message["subscription"])
        if queue is not None:
            dropped = queue.popleft() if len(queue) == queue.maxlen else None
            queue.append(message)
            if dropped:
                queue[0]["lost"] = queue[0].get("lost", 0) + dropped.get("lost", 0) + 1

    def _subscribe(self, stream: str, rate: Optional[float], kept: int) -> int:
        number: int = self.call("subscribe", stream=stream, rate=rate)["subscription"]
        self._queues[number] = deque(maxlen=kept)
        return number

    def _unsubscribe(self, number: int) -> None:
        del self._queues[number]
        if self._socket.fileno() >= 0:  # an iterator may outlive its connection
            self.call("unsubscribe", subscription=number)

    def _messages(self, stream: str, rate: Optional[float]) -> Iterator[dict[str, Any]]:
        """Subscribes at once, so that nothing is missed before the first message is read."""
        return self._received(stream, rate, self._subscribe(stream, rate, KEPT))

    def _received(self, stream: str, rate: Optional[float], number: int) -> Iterator[dict[str, Any]]:
        try:
            while True:
                while stream == "events" and not self._queues[number]:  # the run may be silent, but answers
                    self._read(time.monotonic() + self.timeout) or self.status()
                limit = self.timeout + (1 / rate if rate else 0)
                self._await(lambda: self._queues[number], limit, "joint state", "is publish_joint_state on?")
                yield self._queues[number].popleft()
        finally:
            self._unsubscribe(number)
