"""Tries assets/python/dimos_client against runs that hang: everything that waits has a bound."""

import faulthandler
import json
import socket
import tempfile
import threading
import time
from pathlib import Path

import dimos_client as dimos
from dimos_client import client

TIMEOUT = 0.3
client.STALLED = 0.3
faulthandler.dump_traceback_later(60, exit=True)  # ends a wait without a bound


class Run:
    """A run that answers only the methods in `answers`: with a value, or with what a function returns."""

    def __init__(self, folder, **answers):
        self.answers, self.asked, path = answers, [], Path(tempfile.mktemp(dir=folder))
        self.listener = socket.socket(socket.AF_UNIX)
        self.listener.bind(str(path))
        self.listener.listen()
        self.client = dimos.Client(path, TIMEOUT)
        self.connection, _ = self.listener.accept()
        threading.Thread(target=self.serve, daemon=True).start()

    def serve(self):
        try:
            for line in self.connection.makefile():
                request = json.loads(line)
                self.asked.append(request["method"])
                answer = self.answers.get(request["method"])
                if answer is not None:
                    self.send({"id": request["id"], "result": answer() if callable(answer) else answer})
        except OSError:
            pass  # the client has gone

    def send(self, message):
        self.connection.sendall(json.dumps(message).encode() + b"\n")


def failed(kind, code, act):
    try:
        act()
    except kind as error:
        assert error.code == code, error
        return str(error)
    raise AssertionError(f"{code} was expected")


def a_run_that_publishes_no_joint_states(folder):
    run = Run(folder, subscribe={"subscription": 1}, unsubscribe={})
    text = failed(dimos.ConnectionLost, "NO_ANSWER", lambda: next(run.client.joint_states()))
    assert "no joint state within 0.3 s" in text, text


def a_rate_below_the_timeout(folder):
    data = {"tick": 1, "stamp": 1.0, "name": ["a"], "position": [0.5], "velocity": [None], "effort": [None]}
    run = Run(folder, subscribe={"subscription": 1}, unsubscribe={})
    message = {"stream": "coordinator_joint_state", "subscription": 1, "data": data}
    threading.Timer(3 * TIMEOUT, run.send, [message]).start()
    state = next(run.client.joint_states(rate=0.1))
    assert (state.tick, state.name, state.position, state.lost) == (1, ["a"], [0.5], 0), state


def events_that_are_far_apart(folder):
    def status():
        if run.asked.count("status") == 3:
            run.send({"stream": "events", "subscription": 1, "data": "at last"})
        return {}

    run = Run(folder, subscribe={"subscription": 1}, unsubscribe={}, status=status)
    assert next(run.client.events()) == "at last"
    assert run.asked[:4] == ["subscribe", "status", "status", "status"], run.asked


def events_of_a_run_that_hangs(folder):
    run = Run(folder, subscribe={"subscription": 1})
    failed(dimos.ConnectionLost, "NO_ANSWER", lambda: next(run.client.events()))
    assert "status" in run.asked


def a_run_that_streams_and_does_not_reply(folder):
    def flood():
        try:
            while True:
                run.send({"stream": "events", "subscription": 9, "data": 1})
        except OSError:
            pass

    run = Run(folder)
    threading.Thread(target=flood, daemon=True).start()
    failed(dimos.ConnectionLost, "NO_ANSWER", run.client.status)
    run.client.close()


def a_motion_without_progress(folder):
    motion = {"done": False, "elapsed": 0.1, "state": "EXECUTING", "task": "traj_arm", "error": None}
    run = Run(folder, motion=motion, cancel={"tasks": {"traj_arm": "CANCELLED"}})
    text = failed(dimos.MotionFailed, "EXECUTING", lambda: run.client.wait(7))
    assert "no progress within 0.3 s: cancelled" in text, text
    assert run.asked[-1] == "cancel", run.asked


def a_motion_that_takes_longer(folder):
    began = time.monotonic()

    def motion():
        elapsed = time.monotonic() - began
        return {"done": elapsed > 1.0, "elapsed": elapsed, "state": "COMPLETED", "task": "traj_arm", "error": None}

    run = Run(folder, motion=motion)
    assert run.client.wait(7)["elapsed"] > 1.0
    assert "cancel" not in run.asked


with tempfile.TemporaryDirectory() as folder:
    a_run_that_publishes_no_joint_states(folder)
    a_rate_below_the_timeout(folder)
    events_that_are_far_apart(folder)
    events_of_a_run_that_hangs(folder)
    a_run_that_streams_and_does_not_reply(folder)
    a_motion_without_progress(folder)
    a_motion_that_takes_longer(folder)
print("all waits have ended")
