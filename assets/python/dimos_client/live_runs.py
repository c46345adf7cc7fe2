"""The live runs, where the command line finds them: by their locks, and by their marks in the kernel."""

from __future__ import annotations

import fcntl
import os
import socket
import stat
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Optional, Union

from .errors import NoRun

_LISTENING = "00010000"  # flag of a socket in /proc/net/unix
_Row = tuple[str, str]  # inode and path of a socket


def runs() -> dict[str, Path]:
    """The sockets of the live runs of this user, by name; @NAME is an abstract one."""
    folder, prefix, is_open = _world()
    here = _rows("self")
    live = {name: socket for name in _marked(here, prefix) if (socket := _here(here, prefix, name))}
    for name, path, pid in _locked(folder):
        if name not in live and _is_of_other_world(here, prefix, name, pid):
            continue
        if str(live.get(name, "@")).startswith("@") and (name not in live or path.exists()):
            live[name] = path
    if is_open:
        for name, path in _elsewhere({inode for inode, _ in here}, prefix):
            live.setdefault(name, path)
    return dict(sorted(live.items()))


def _address(path: Union[str, Path]) -> str:
    """The address of a socket in the kernel."""
    text = str(path)
    return "\0" + text[1:] if text.startswith("@") else text


def _peer(connection: socket.socket) -> tuple[int, int]:
    """Process id and user at the other end."""
    pid, uid, _ = struct.unpack("3i", connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
    return pid, uid


def _world() -> tuple[Path, str, bool]:
    """The run directory, the beginning of the marks of its runs, and whether others are looked for."""
    uid, world = os.geteuid(), os.environ.get("DIMOS_WORLD")
    if world is None:
        base = os.environ.get("XDG_RUNTIME_DIR", "")
        folder = Path(base, "dimos") if os.path.isdir(base) else Path(tempfile.gettempdir(), f"dimos-{uid}")
        return folder, f"dimos/run/{uid}/", True
    real = Path(os.path.realpath(world))
    if not world or not _is_ours(real):
        raise NoRun("NO_WORLD", f"DIMOS_WORLD={world} is not a directory of this user", "unset it, or make it")
    number = 0xCBF29CE484222325  # FNV-1a
    for byte in os.fsencode(real / "dimos"):
        number = (number ^ byte) * 0x100000001B3 % 2**64
    return real / "dimos", f"dimos/run/{uid}@{number:016x}/", False


def _is_ours(folder: Path) -> bool:
    try:
        found = os.lstat(folder)
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid()


def _locked(folder: Path) -> Iterator[tuple[str, Path, int]]:
    """Runs with a lock in a directory of this user, and their pids. Nothing there is followed, or waited for."""
    try:
        locks = sorted(folder.glob("*.lock")) if _is_ours(folder) else []
    except OSError:
        return
    for lock in locks:
        try:
            file = os.open(lock, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError:
            continue
        try:
            found = os.fstat(file)
            is_lock = stat.S_ISREG(found.st_mode) and found.st_uid == os.geteuid() and found.st_nlink <= 1
            pid = b"0" + os.read(file, 20).strip() if is_lock and found.st_size <= 20 else b""
            if pid.isdigit():
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)  # what is not locked is what a dead run left
        except BlockingIOError:
            yield lock.stem, lock.with_suffix(".sock"), int(pid)
        except OSError:
            pass
        finally:
            os.close(file)


def _rows(pid: str) -> list[_Row]:
    """The listening sockets in the network namespace of a process; none if it cannot be seen."""
    try:
        with open(f"/proc/{pid}/net/unix", errors="surrogateescape") as table:
            columns = [line.rstrip("\n").split(None, 7) for line in table]
    except OSError:
        return []
    return [(row[6], row[7]) for row in columns if len(row) == 8 and row[3] == _LISTENING]


def _marked(rows: list[_Row], prefix: str) -> list[str]:
    names = [path[len(prefix) + 1 :] for _, path in rows if path.startswith(f"@{prefix}")]
    return [name for name in names if name and "/" not in name]


def _peer_at(path: str) -> Optional[tuple[int, int]]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.setblocking(False)
        try:
            connection.connect(_address(path))
            return _peer(connection)
        except BlockingIOError:  # many wait there: it is live
            return 0, os.geteuid()
        except OSError:
            return None


def _is_of_other_world(rows: list[_Row], prefix: str, name: str, pid: int) -> bool:
    """Whether a process has a mark of this name in another world."""
    user = prefix.split("@")[0].rstrip("/")
    marks = [path for _, path in rows if path.startswith(f"@{user}") and path != f"@{prefix}{name}"]
    worlds = [(path, path[len(user) + 1 :].partition("/")) for path in marks]
    others = [path for path, (world, _, found) in worlds if found == name and world[:1] in ("", "@")]
    return any((_peer_at(path) or (-1, 0))[0] == pid for path in others)


def _here(rows: list[_Row], prefix: str, name: str) -> Optional[Path]:
    """The socket of a run with a mark in this network namespace; None if another user has the mark."""
    mark = f"@{prefix}{name}"
    holder = _peer_at(mark)
    if holder is None or holder[1] != os.geteuid():
        return None
    paths = [path for _, path in rows if path.startswith("/") and path.endswith(f"/{name}.sock")]
    return Path(next((path for path in paths if _peer_at(path) == holder), mark))


def _elsewhere(known: set[str], prefix: str) -> Iterator[tuple[str, Path]]:
    """Runs with marks in the network namespaces of other processes of this user, by a path that leads there."""
    for pids in _other_namespaces():
        rows = next(filter(None, map(_rows, pids)), [])  # a process may be closed to this one, another one is not
        for inode, path in rows:
            names = _marked([(inode, path)], prefix)
            if inode in known or not names:
                continue
            known.add(inode)
            ways = [way for _, way in rows if way.startswith("/") and way.endswith(f"/{names[0]}.sock")]
            for way in [f"/proc/{pid}/root{way}" for way in ways for pid in pids] + ways:
                pid, user = _peer_at(way) or (-1, -1)
                if user == os.geteuid() and (pid == 0 or str(pid) in pids):  # a run of this namespace may be there
                    yield names[0], Path(way)
                    break


def _other_namespaces() -> list[list[str]]:
    """The processes of this user in each other network namespace. One whose namespace is not known is alone in it."""
    own = _namespace("self")
    found: dict[Union[int, str], list[str]] = {}
    for pid in filter(str.isdigit, os.listdir("/proc")):
        try:
            with open(f"/proc/{pid}/status") as status:
                users = next(line for line in status if line.startswith("Uid:")).split()
        except (OSError, StopIteration):
            continue
        namespace = _namespace(pid)
        if int(users[2]) == os.geteuid() and (namespace is None or namespace != own):
            found.setdefault(namespace or pid, []).append(pid)
    return list(found.values())


def _namespace(pid: str) -> Optional[int]:
    """The number of the network namespace of a process; None if it is not shown."""
    try:
        return os.stat(f"/proc/{pid}/ns/net").st_ino
    except OSError:
        return None
