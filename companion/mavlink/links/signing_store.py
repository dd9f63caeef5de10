"""Signing keys in files, and signing timestamps that persist across runs.

Without the timestamps of the last run, any recorded frame could be replayed to the next one. After
a kill or a power loss the file lags behind: it is written every second, or every three while no
frame is received or sent, and a write may take two more. The sum is ``signing.MARGIN``, by which
the next run starts later. A link that was closed properly resumes where it ended.

Over 300 lines: all that is kept of signing on disk.
"""

import contextlib
import fcntl
import json
import os
import stat
import threading
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any, Final, NamedTuple

from companion.mavlink.links.regular_file import open_regular, replace_file
from companion.mavlink.links.urls import LinkError
from companion.mavlink.trust.signing import (
    KEY_BYTES,
    LATEST,
    LinkSigning,
    NewestTimestamps,
    State,
    StoredStream,
    fingerprint,
)

SAVE_NS: Final = 1_000_000_000  # shortest time between two writes
REFRESH_NS: Final = 3_000_000_000
"""Longest time between two writes: the clock of a silent link advances too."""
_VERSION: Final = 1
_READ_MAX: Final = 4096  # most bytes read of a key file
_FILE_MAX: Final = 1 << 23
"""Most bytes read of a timestamps file: 30 links with as many streams as are remembered."""


# --- keys ---------------------------------------------------------------------------------------


def load_key(path: Path) -> bytes:
    """Read the 32 bytes of a signing key from a file of exactly these bytes, or of 64 hex digits.

    Raises ``LinkError``, with the fault of the file and the command that creates a key. Mission
    Planner and MAVProxy use the SHA-256 of a passphrase (``MAVAuthKeys.AddKey``, UTF-8;
    ``passphrase_to_key`` of the module ``signing``, ASCII).
    """
    try:
        with open_regular(path) as file:
            data = file.read(_READ_MAX)
    except OSError as error:
        raise LinkError(f"{path}: cannot read the signing key: {error.strerror}") from None
    if len(data) != KEY_BYTES:
        try:
            text = data.decode("ascii").strip()
            data = bytes.fromhex(text) if len(text) == 2 * KEY_BYTES else b""
        except ValueError:
            data = b""
    if len(data) != KEY_BYTES:
        raise LinkError(f"{path}: not a signing key: {_how_to_make(path)}")
    if not any(data):
        raise LinkError(f"{path}: signing key is all zeros, which disables signing; give another")
    return data


def key_warning(path: Path) -> str | None:
    """Return a warning if other users may read or change a key file; else None."""
    try:
        mode = path.stat().st_mode
    except OSError as error:
        return f"{path}: cannot check the permissions of the signing key: {error.strerror}"
    if stat.S_IMODE(mode) & (stat.S_IRWXG | stat.S_IRWXO):
        return f"{path}: other users may read or change the signing key: chmod 600 {path}"
    return None


def _how_to_make(path: Path) -> str:
    return (
        f"give 32 bytes or 64 hex digits; from a passphrase, as in Mission Planner and MAVProxy: "
        f"printf %s 'PASSPHRASE' | sha256sum | cut -c1-64 > {path}"
    )


# --- timestamps ---------------------------------------------------------------------------------


class _LinkKey(NamedTuple):
    """Identity of a set of timestamps: a link's URL and the fingerprint of its key."""

    url: str
    key: str


class _Kept(NamedTuple):
    """Stored state of a link; ``clean`` if the link was closed properly."""

    state: State
    clean: bool


class SigningSnapshot(NamedTuple):
    """Signing states to write; ``number`` counts the snapshots."""

    number: int
    links: Mapping[_LinkKey, _Kept]


class Timestamps:
    """Timestamps of all links with a key, in one file.

    The event loop checks ``due`` and takes a ``snapshot``; a thread does the ``write``::

        if timestamps.due(now_ns):
            await in_daemon_thread(partial(timestamps.write, timestamps.snapshot(now_ns)))

    Call ``close`` at the end, when no frame is received or sent any more. States of unused links
    stay in the file. Raises ``LinkError`` if the file is damaged, cannot be read or written, or is
    in use by another process.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._guards: dict[_LinkKey, LinkSigning] = {}
        self._senders: dict[str, NewestTimestamps] = {}  # by the fingerprint of the key
        self._number = 0
        self._snapshot_ns = 0
        self._moves = 0
        self._writing = threading.Lock()
        self._written = 0
        self._lock = _locked(path)
        try:
            self._kept = _read(path)
            self._number += 1
            # Write now, so that an unwritable path is reported at the start.
            self.write(SigningSnapshot(self._number, self._kept))
        except LinkError:
            os.close(self._lock)
            raise
        for link, kept in self._kept.items():
            self._senders.setdefault(link.key, NewestTimestamps()).note_all(kept.state)

    def guard(
        self, url: str, key: bytes, link_id: int, now_ns: int, *, allow_unsigned: bool = False
    ) -> LinkSigning:
        """Return the guard of a link, with its last state for this key.

        The file is then marked as in use: if the process is killed, the next one starts later.
        Raises ``LinkError`` also for a link given twice.
        """
        link = _LinkKey(url, fingerprint(key))
        if link in self._guards:
            raise LinkError(f"{url}: two links have the same address and key")
        kept = self._kept.get(link, _Kept(State(), clean=True))
        state = kept.state if kept.clean else kept.state.after_crash()
        guard = LinkSigning(
            key=key,
            link_id=link_id,
            allow_unsigned=allow_unsigned,
            state=state,
            senders=self._senders.setdefault(link.key, NewestTimestamps()),
        )
        self._guards[link] = guard
        self.write(self.snapshot(now_ns))
        return guard

    def due(self, now_ns: int) -> bool:
        """Return whether it is time for a ``snapshot`` and a ``write``."""
        moved = self._moves != sum(guard.moves for guard in self._guards.values())
        return bool(self._guards) and now_ns - self._snapshot_ns >= (
            SAVE_NS if moved else REFRESH_NS
        )

    def snapshot(self, now_ns: int) -> SigningSnapshot:
        """Return the state of all links; ``now_ns`` is the own clock, ns since the Unix epoch."""
        return self._snapshot(now_ns, clean=False)

    def write(self, snapshot: SigningSnapshot) -> None:
        """Write a snapshot to disk, from any thread; skip one older than the file.

        On return, the data survive a power loss.
        """
        with self._writing:
            if snapshot.number <= self._written:
                return
            try:
                replace_file(self._path, _encoded(snapshot.links), mode=0o600)
            except OSError as error:
                raise _unwritable(self._path, error) from None
            self._written = snapshot.number

    def close(self, now_ns: int) -> None:
        """Record that all links were closed properly. No guard may be used afterwards."""
        try:
            self.write(self._snapshot(now_ns, clean=True))
        finally:
            os.close(self._lock)

    def _snapshot(self, now_ns: int, *, clean: bool) -> SigningSnapshot:
        self._number += 1
        self._snapshot_ns = now_ns
        self._moves = sum(guard.moves for guard in self._guards.values())
        current = {link: _Kept(guard.state(now_ns), clean) for link, guard in self._guards.items()}
        return SigningSnapshot(self._number, self._kept | current)


def _locked(path: Path) -> int:
    """Return a descriptor that locks the file against other processes until closed."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = os.open(_beside(path, ".lock"), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise _unwritable(path, error) from None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(lock)
        if isinstance(error, BlockingIOError):
            raise LinkError(f"{path}: signing timestamps are in use by another process") from None
        raise _unwritable(path, error) from None
    return lock


def _read(path: Path) -> dict[_LinkKey, _Kept]:
    """Return the content of the timestamps file; empty if there is no file yet."""
    try:
        with open_regular(path) as file:
            data = file.read(_FILE_MAX + 1)
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise LinkError(f"{path}: cannot read the signing timestamps: {error.strerror}") from None
    kept = None if len(data) > _FILE_MAX else _checked(data)
    if kept is None:
        raise LinkError(
            f"{path}: signing timestamps are damaged; restore a copy, or remove the file: frames "
            "of the minute before could then be replayed once"
        )
    return kept


def _checked(data: bytes) -> dict[_LinkKey, _Kept] | None:
    """Return the content of a timestamps file; None if it is damaged."""
    with contextlib.suppress(ValueError, RecursionError, TypeError, KeyError):
        content = json.loads(data)
        if content["version"] == _VERSION and content["sha256"] == _digest(content["links"]):
            links = content["links"]
            return {_LinkKey(str(one["url"]), str(one["key"])): _kept(one) for one in links}
    return None


def _kept(link: Mapping[str, Any]) -> _Kept:
    streams = {
        (_whole(sysid), _whole(compid), _whole(link_id)): StoredStream(
            _whole(newest), *(None if value is None else _whole(value) for value in rest)
        )
        for sysid, compid, link_id, newest, *rest in link["streams"]  # older files have no pace
    }
    state = State(
        clock=_whole(link["clock"]),
        local=_whole(link["local"]),
        sent=_whole(link["sent"]),
        floor=_whole(link["floor"]),
        streams=streams,
    )
    return _Kept(state, bool(link["clean"]))


def _whole(value: object) -> int:
    if not isinstance(value, int) or abs(value) > LATEST:
        raise ValueError
    return value


def _encoded(links: Mapping[_LinkKey, _Kept]) -> bytes:
    content = [
        {
            "url": link.url,
            "key": link.key,
            "clean": clean,
            "clock": state.clock,
            "local": state.local,
            "sent": state.sent,
            "floor": state.floor,
            "streams": [[*stream, *known] for stream, known in state.streams.items()],
        }
        for link, (state, clean) in links.items()
    ]
    return _dumped({"version": _VERSION, "sha256": _digest(content), "links": content})


def _digest(links: object) -> str:
    return sha256(_dumped(links)).hexdigest()


def _dumped(value: object) -> bytes:
    return json.dumps(value, separators=(",", ":")).encode("ascii")


def _beside(path: Path, ending: str) -> Path:
    return path.with_name(path.name + ending)


def _unwritable(path: Path, error: OSError) -> LinkError:
    return LinkError(f"{path}: cannot write the signing timestamps: {error.strerror}")
