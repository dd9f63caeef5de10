"""Requirements of a run on this machine: ports, devices, disk, time."""

import contextlib
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

LOW_DISK_BYTES: Final = 2_000_000_000
"""Free disk space below which recordings are at risk: it holds some hours of four UAVs."""
BUFFER_BYTES: Final = 1_000_000
"""Receive buffer below which bursts of UDP may be lost (docs/links.md)."""
UNSYNCHRONISED_STATE: Final = 5  # TIME_ERROR of adjtimex(2): the clock is not synchronised


class Grade(StrEnum):
    """Grade of a finding: in order, doubtful, or a fault that prevents a run."""

    OK = "ok"
    DOUBT = "doubt"
    FAULT = "fault"


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """Finding of a check: the checked item, its grade, and a remedy."""

    subject: str
    grade: Grade
    text: str
    remedy: str = ""

    @classmethod
    def ok(cls, subject: str, text: str) -> "Finding":
        """Return a finding that is in order."""
        return cls(subject=subject, grade=Grade.OK, text=text)

    @classmethod
    def doubt(cls, subject: str, text: str, remedy: str = "") -> "Finding":
        """Return a doubtful finding."""
        return cls(subject=subject, grade=Grade.DOUBT, text=text, remedy=remedy)

    @classmethod
    def fault(cls, subject: str, text: str, remedy: str = "") -> "Finding":
        """Return a finding that prevents a run."""
        return cls(subject=subject, grade=Grade.FAULT, text=text, remedy=remedy)


def look(settings: Settings, *, token: str | None, insecure: bool) -> Iterator[Finding]:
    """Yield findings about this machine's ports, devices, disk and clock; keeps nothing open."""
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
        remedy = "stop the other program, or give --listen 127.0.0.1:8081" if busy else ""
        return Finding.fault(subject, str(error), remedy)
    return Finding.ok(subject, "available for the page and the API")


def _link(url: LinkUrl) -> Finding:
    subject = f"link {url}"
    if url.scheme == "serial":
        return _device(subject, Path(url.host))
    if url.scheme == "zenoh":
        return _zenoh(subject, url)
    if not url.listens:
        return Finding.ok(subject, "connects to its peer")
    kind = socket.SOCK_STREAM if url.scheme == "tcpin" else socket.SOCK_DGRAM
    try:
        bound(url, kind).close()
    except OSError as error:
        remedy = "stop the program that uses it, or choose another port"
        if error.errno != errno.EADDRINUSE:
            remedy = "give an address of this machine, such as 0.0.0.0"
        return Finding.fault(subject, reason(error), remedy)
    return Finding.ok(subject, "available for listening")


def _zenoh(subject: str, url: LinkUrl) -> Finding:
    try:
        zenoh_bus.check(zenoh_link.configuration(url))
    except UserError as error:
        return Finding.fault(subject, str(error))
    return Finding.ok(subject, "Zenoh is installed, and its endpoints are valid")


def _device(subject: str, device: Path) -> Finding:
    if not device.exists():
        there = sorted(str(path) for path in Path("/dev").glob("tty[AUT][CMSH][MABS]*"))
        remedy = "check that it is plugged in"
        if there:
            remedy += f"; devices: {', '.join(there)}"
        return Finding.fault(subject, "device does not exist", remedy)
    if not os.access(device, os.R_OK | os.W_OK):
        group = grp.getgrgid(device.stat().st_gid).gr_name
        remedy = f"sudo usermod -a -G {group} $USER, then log in again"
        return Finding.fault(subject, "no permission to open it", remedy)
    return Finding.ok(subject, "device exists and can be opened")


def _buffers() -> Iterator[Finding]:
    try:
        granted = int(Path("/proc/sys/net/core/rmem_max").read_text(encoding="ascii"))
    except (OSError, ValueError):
        return  # not Linux: links report their buffer size
    text = f"the system allows UDP links {granted / 1e3:.0f} kB"
    if granted < BUFFER_BYTES:
        remedy = f"for thousands of frames a second: sysctl -w net.core.rmem_max={4 * BUFFER_BYTES}"
        yield Finding.doubt("receive buffer", text, remedy)
    else:
        yield Finding.ok("receive buffer", text)


def _disk(folder: Path) -> Finding:
    subject = f"recordings {folder}"
    where = folder.parent if folder.suffix == ".mcap" else folder
    try:
        with contextlib.suppress(FileNotFoundError):
            folder.lstat()  # fails for a name that is too long
        while not where.exists() and not where.is_symlink() and where != where.parent:
            where = where.parent  # created when the first recording begins
        with tempfile.TemporaryFile(dir=where):
            free = shutil.disk_usage(where).free
    except OSError as error:
        return Finding.fault(
            subject, reason(error), "choose a writable folder in `[recording] directory`"
        )
    text = f"{free / 1e9:.1f} GB free"
    if free < LOW_DISK_BYTES:
        return Finding.doubt(subject, text, "free some space: a full disk ends a recording")
    return Finding.ok(subject, text)


def processor_share(root: Path = Path("/")) -> float:
    """Return the fraction of a processor that control groups allow this process; 1: no quota.

    A quota, as of a container, suspends the process for part of the time, which processor time does
    not show. ``root`` is the root of the system's files.
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
    """Return the processor quota of one control group, of either version; infinite without one."""
    names = (("cpu.max",), ("cpu.cfs_quota_us", "cpu.cfs_period_us"))
    for name in names:
        try:
            quota, period = " ".join((folder / one).read_text() for one in name).split()
            return float(quota) / float(period) if float(quota) > 0 else math.inf
        except (OSError, ValueError):  # missing, "max", or the other version
            continue
    return math.inf


def _clock() -> Iterator[Finding]:
    """Check whether the wall clock is synchronised, by adjtimex(2)."""
    try:
        state = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(512))
    except (OSError, AttributeError):
        return  # not Linux
    if state == UNSYNCHRONISED_STATE:
        text = "the clock is not synchronised: times in recordings may be wrong"
        yield Finding.doubt("wall clock", text, "run chrony or systemd-timesyncd")
    elif state >= 0:
        yield Finding.ok("wall clock", "synchronised")
