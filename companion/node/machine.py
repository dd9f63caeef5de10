"""What a run needs of this machine: ports, devices, disk, time.                          [shell]"""

import ctypes
import errno
import grp
import math
import os
import shutil
import socket
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Final

from companion.mavlink.links import zenoh_bus, zenoh_link
from companion.mavlink.links.endpoints import bound, reason
from companion.mavlink.links.urls import LinkUrl, parse_link
from companion.server.access import bind
from companion.settings.model import Settings
from companion.values import UserError

SCARCE_BYTES: Final = 2_000_000_000
"""Free disk below which recordings are in danger: some hours of four UAVs."""
BUFFER_BYTES: Final = 1_000_000
"""Receive buffer below which bursts of UDP may be lost (docs/links.md)."""
UNSYNCHRONISED: Final = 5  # what adjtimex(2) answers where nothing keeps the clock: TIME_ERROR


class Grade(StrEnum):
    """How a thing was found: in order, worth a thought, or a fault that stops a run."""

    OK = "ok"
    DOUBT = "doubt"
    FAULT = "fault"


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One thing that was looked at: what it is, how it was found, and what to do about it."""

    subject: str
    grade: Grade
    text: str
    remedy: str = ""


def look(settings: Settings, *, token: str | None, insecure: bool) -> Iterator[Finding]:
    """Findings on all that settings ask of this machine, nothing of which is kept open."""
    yield _served(settings.server.listen, token=token, insecure=insecure)
    for url in settings.links.urls:
        yield _link(parse_link(url))
    if any(url.startswith("udp") for url in settings.links.urls):
        yield from _buffers()
    if settings.recording.directory is not None:
        yield _disk(Path(settings.recording.directory))
    yield from _clock()


def _served(listen: str, *, token: str | None, insecure: bool) -> Finding:
    subject = f"http {listen}"
    try:
        bind(listen, token=token, insecure=insecure).close()
    except UserError as error:
        busy = os.strerror(errno.EADDRINUSE) in str(error)
        remedy = "stop the other program, or --listen 127.0.0.1:8081" if busy else ""
        return Finding(subject=subject, grade=Grade.FAULT, text=str(error), remedy=remedy)
    return Finding(subject=subject, grade=Grade.OK, text="the page and the API can be served here")


def _link(url: LinkUrl) -> Finding:
    subject = f"link {url}"
    if url.scheme == "serial":
        return _device(subject, Path(url.host))
    if url.scheme == "zenoh":
        return _zenoh(subject, url)
    if not url.listens:
        return Finding(subject=subject, grade=Grade.OK, text="calls from here")
    kind = socket.SOCK_STREAM if url.scheme == "tcpin" else socket.SOCK_DGRAM
    try:
        bound(url, kind).close()
    except OSError as error:
        remedy = "another program has it: stop that, or choose another port"
        if error.errno != errno.EADDRINUSE:
            remedy = "name an address of this machine, such as 0.0.0.0"
        return Finding(subject=subject, grade=Grade.FAULT, text=reason(error), remedy=remedy)
    return Finding(subject=subject, grade=Grade.OK, text="can be listened on")


def _zenoh(subject: str, url: LinkUrl) -> Finding:
    try:
        zenoh_bus.check(zenoh_link.configuration(url))
    except UserError as error:
        return Finding(subject=subject, grade=Grade.FAULT, text=str(error))
    return Finding(
        subject=subject, grade=Grade.OK, text="Zenoh is here, and can read its endpoints"
    )


def _device(subject: str, device: Path) -> Finding:
    if not device.exists():
        there = sorted(str(path) for path in Path("/dev").glob("tty[AUT][CMSH][MABS]*"))
        remedy = f"is it plugged in? there is {', '.join(there)}" if there else "is it plugged in?"
        return Finding(
            subject=subject, grade=Grade.FAULT, text="there is no such device", remedy=remedy
        )
    if not os.access(device, os.R_OK | os.W_OK):
        group = grp.getgrgid(device.stat().st_gid).gr_name
        remedy = f"sudo usermod -a -G {group} $USER, then log in again"
        return Finding(
            subject=subject, grade=Grade.FAULT, text="may not be opened by this user", remedy=remedy
        )
    return Finding(subject=subject, grade=Grade.OK, text="is there, and may be opened")


def _buffers() -> Iterator[Finding]:
    try:
        granted = int(Path("/proc/sys/net/core/rmem_max").read_text(encoding="ascii"))
    except (OSError, ValueError):
        return  # not Linux: links say what they were granted
    text = f"the system grants UDP links {granted / 1e3:.0f} kB"
    if granted < BUFFER_BYTES:
        remedy = f"for thousands of frames a second: sysctl -w net.core.rmem_max={4 * BUFFER_BYTES}"
        yield Finding(subject="receive buffer", grade=Grade.DOUBT, text=text, remedy=remedy)
    else:
        yield Finding(subject="receive buffer", grade=Grade.OK, text=text)


def _disk(folder: Path) -> Finding:
    subject = f"recordings {folder}"
    where = folder.parent if folder.suffix == ".mcap" else folder
    while not where.exists() and where != where.parent:
        where = where.parent  # it is made when the first recording begins
    try:
        with tempfile.TemporaryFile(dir=where):
            free = shutil.disk_usage(where).free
    except OSError as error:
        return Finding(
            subject=subject,
            grade=Grade.FAULT,
            text=reason(error),
            remedy="choose a folder that can be written",
        )
    text = f"{free / 1e9:.1f} GB free"
    if free < SCARCE_BYTES:
        return Finding(
            subject=subject,
            grade=Grade.DOUBT,
            text=text,
            remedy="make room: a full disk ends a recording",
        )
    return Finding(subject=subject, grade=Grade.OK, text=text)


def processor_share(root: Path = Path("/")) -> float:
    """The share of one processor that this process may have by its control groups; 1: all of it.

    A quota, as of a container, stops the process for a part of the time, of which the time that it
    takes of a processor knows nothing. ``root`` is where the system's files are.
    """
    try:
        lines = (root / "proc/self/cgroup").read_text(encoding="utf-8").splitlines()
    except OSError:
        return 1.0  # not Linux
    shares = [1.0]
    for line in lines:
        _, kinds, path = line.split(":", 2)
        if kinds and "cpu" not in kinds.split(","):
            continue
        top = root / "sys/fs/cgroup" / ("cpu" if kinds else "")
        inner = top / path.lstrip("/")
        shares += [
            _quota(folder) for folder in (inner, *inner.parents) if top in (folder, *folder.parents)
        ]
    return min(shares)


def _quota(folder: Path) -> float:
    """The quota of one control group, of either version; infinite where it has none."""
    names = (("cpu.max",), ("cpu.cfs_quota_us", "cpu.cfs_period_us"))
    for name in names:
        try:
            quota, period = " ".join((folder / one).read_text() for one in name).split()
            return float(quota) / float(period) if float(quota) > 0 else math.inf
        except (OSError, ValueError):  # none, "max", or the other version
            continue
    return math.inf


def _clock() -> Iterator[Finding]:
    """Whether the wall clock is kept by something, as adjtimex(2) has it."""
    try:
        state = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(512))
    except (OSError, AttributeError):
        return  # not Linux
    if state == UNSYNCHRONISED:
        text = "nothing keeps this machine's clock right: times in recordings are as it has them"
        yield Finding(
            subject="wall clock",
            grade=Grade.DOUBT,
            text=text,
            remedy="run chrony or systemd-timesyncd",
        )
    elif state >= 0:
        yield Finding(subject="wall clock", grade=Grade.OK, text="is kept right")
