"""A client of a shared run that uses none of our code: eclipse-zenoh and the keys of docs/many-machines.md.

Reads one command per line from stdin, as JSON, and answers each with one line. The first line has the endpoint, the
run, the user, and the files for TLS.
"""

import json
import random
import sys
import threading
import time
from typing import Any

import zenoh


def main():
    opening = json.loads(sys.stdin.readline())
    settings = {
        "mode": "client",
        "connect/endpoints": [opening["at"]],
        "connect/timeout_ms": 2000,
        "scouting/multicast/enabled": False,
        "transport/link/tx/lease": 1000,
    }
    for name in ["root_ca_certificate", "connect_certificate", "connect_private_key"]:
        if name in opening:
            settings[f"transport/link/tls/{name}"] = opening[name]
            settings["transport/link/tls/enable_mtls"] = True
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        print(json.dumps({"refused": str(error)}), flush=True)
        return
    client = Client(session, opening["run"], opening.get("user", "-"))
    print(json.dumps({"id": client.id}), flush=True)
    for line in sys.stdin:
        command = json.loads(line)
        print(json.dumps(getattr(client, command.pop("do"))(**command)), flush=True)
    session.close()


def damaged(dice, payload):
    """A payload with a few bytes changed, cut, repeated or nested; or none of it at all."""
    kind = dice.randrange(8)
    if kind == 0:
        return dice.randbytes(dice.randrange(0, 2000))
    if kind == 1:
        depth = dice.choice([10, 127, 128, 1000, 20000])
        return b"[" * depth + dice.choice([b"", b"]" * depth])
    if kind == 2:
        return b'{"a": ' + dice.choice([b"1e999", b"-0", b"NaN", b'"\\ud800"', b"9" * 400, b"null", b"{}"]) + b"}"
    if kind == 3:
        return payload * dice.randrange(2, 50)
    if kind == 4:
        return payload[: dice.randrange(len(payload) + 1)]
    if kind == 5:
        return payload.replace(b"0", dice.choice([b"1e308", b'"x"', b"[]", b"-1", b"null", b"true"]))
    changed = bytearray(payload)
    for _ in range(dice.randrange(1, 6)):
        changed[dice.randrange(len(changed))] = dice.randrange(256)
    return bytes(changed)


def damaged_key(dice, key):
    """A key with a part changed; half of them stay as they are."""
    parts = key.split("/")
    if dice.random() < 0.5:
        return key
    strange = ["*", "**", "$*", "a$*b", "@", "\u202e", "%2e%2e", "x" * 300, "-", "..", "é", "MOVE", "stop ", "\x00"]
    parts[dice.randrange(len(parts))] = dice.choice(strange)
    if dice.random() < 0.2:
        parts.insert(dice.randrange(len(parts)), dice.choice(strange))
    return "/".join(parts)


class Client:
    def __init__(self, session, run, user):
        self.session, self.id = session, str(session.zid())
        self.own = f"dimos/{run}/by/{user}"
        self.root = f"dimos/{run}"
        self.token = None
        self.more = {}
        self.seen = []
        self.subscribers = []

    def announce(self, key=None):
        self.token = self.session.liveliness().declare_token(key or f"{self.own}/client/{self.id}")
        return {}

    def prove(self, attachment, id=None):
        """Sends this with every request and beat from now on, and speaks for the client of another id."""
        self.more = {"attachment": attachment.encode()} if attachment else {}
        self.id = id or self.id
        return {}

    def beat(self, key=None, name="judge"):
        self.session.put(key or f"{self.own}/client/{self.id}/beat", name, **self.more)
        return {}

    def ask(self, method=None, params=None, cls=None, key=None, size=None, timeout=12.0):
        """One request; what came back: the result, the error, or nothing."""
        payload = "x" * size if size else json.dumps(params or {})
        return self.raw(key or f"{self.own}/{cls}/{self.id}/{method}", payload, timeout)

    def raw(self, key, payload, timeout=12.0):
        began = time.monotonic()
        answers = list(self.session.get(key, payload=payload, timeout=timeout, **self.more))
        took = time.monotonic() - began
        if not answers:
            return {"answers": 0, "took": took}
        if answers[0].ok is None:
            error = answers[0].err
            kind, text = str(error.encoding), error.payload.to_string()
            return {
                "answers": len(answers),
                "error": json.loads(text) if text.startswith("{") else text,
                "encoding": kind,
                "took": took,
            }
        return {"answers": len(answers), "result": json.loads(answers[0].ok.payload.to_string()), "took": took}

    def flood(self, method, cls, count):
        """Many requests at once; how many were answered, refused, and got nothing."""
        key = f"{self.own}/{cls}/{self.id}/{method}"
        pending = [self.session.get(key, payload="{}", timeout=12.0) for _ in range(count)]
        done, refused = 0, 0
        codes: dict[str, int] = {}
        for replies in pending:
            for reply in replies:
                if reply.ok is None:
                    refused += 1
                    try:
                        code = json.loads(reply.err.payload.to_string())["code"]
                    except ValueError:
                        code = reply.err.payload.to_string()
                    codes[code] = codes.get(code, 0) + 1
                else:
                    done += 1
        return {"done": done, "refused": refused, "codes": codes}

    def both(self, slow, fast):
        """Two requests of this client at once."""
        answers: dict[str, Any] = {}
        thread = threading.Thread(target=lambda: answers.update(slow=self.ask(**slow)))
        thread.start()
        time.sleep(0.02)
        answers["fast"] = self.ask(**fast)
        thread.join()
        return answers

    def subscribe(self, stream):
        def note(sample):
            message = json.loads(sample.payload.to_string())
            self.seen.append((message["seq"], time.monotonic()))

        self.subscribers.append(self.session.declare_subscriber(f"{self.root}/stream/{stream}", note))
        return {}

    def heard(self):
        """Messages seen so far, and those lost between them."""
        numbers = [seq for seq, _ in list(self.seen)]
        gaps = sum(b - a - 1 for a, b in zip(numbers, numbers[1:]))
        return {"count": len(numbers), "lost": gaps}

    def fuzz(self, seed, count, valid):
        """Sends `count` damaged requests, puts and tokens, at most 64 at a time; how many were answered, by code."""
        dice, pending = random.Random(seed), []
        codes: dict[str, int] = {}

        def collect(replies):
            for reply in replies:
                try:
                    code = "ok" if reply.ok is not None else json.loads(reply.err.payload.to_string())["code"]
                except (ValueError, KeyError, TypeError):
                    code = "not ours"
                codes[code] = codes.get(code, 0) + 1

        for _ in range(count):
            cls, method, params = dice.choice(valid)
            key = damaged_key(dice, f"{self.own}/{cls}/{self.id}/{method}")
            payload = damaged(dice, json.dumps(params).encode())
            more: dict[str, Any] = {"attachment": dice.randbytes(dice.randrange(1, 300))} if dice.random() < 0.2 else {}
            encoding = dice.choice([None, "application/json", "zenoh/bytes", "text/plain;x=" + "y" * 200])
            if encoding:
                more["encoding"] = encoding
            try:
                if dice.random() < 0.15:
                    self.session.put(key, payload, **more)
                    self.session.put(f"{self.own}/client/{self.id}/beat", payload)
                else:
                    selector = key + dice.choice(["", "", "", "?x=1", "?_time=[now(-1h)..]", "?a;b=" + "c" * 100])
                    pending.append(self.session.get(selector, payload=payload, timeout=2.0, **more))
            except zenoh.ZError:
                codes["no key"] = codes.get("no key", 0) + 1
            if len(pending) >= 64:
                collect(pending.pop(0))
        for replies in pending:
            collect(replies)
        return codes

    def rounds(self, method, cls, count):
        """Round trips of one request, one after the other [ms]."""
        return [1e3 * self.ask(method=method, cls=cls)["took"] for _ in range(count)]

    def tokens(self, key):
        replies = self.session.liveliness().get(key, timeout=2.0)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]


main()
