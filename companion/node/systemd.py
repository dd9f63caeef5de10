"""Notification of systemd about the state of the service, by its protocol.

Each message is one datagram to the Unix socket ``NOTIFY_SOCKET``, with lines of ``NAME=value``
(sd_notify(3)). With ``WatchdogSec`` in the unit, ``WATCHDOG_USEC`` and ``WATCHDOG_PID`` give the
longest allowed silence (sd_watchdog_enabled(3)). Other supervisors use this protocol as well.

A keep-alive is sent only while the event loop runs and beam updates are on time. A service that
hangs, or computes no beams, stays silent and is restarted. Faults that a restart does not fix (a
link that is down, no UAV in the air, a full disk) only appear in the status line.
"""

import asyncio
import os
import socket
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Final

from companion.node.service import Service
from companion.node.serving import pause
from companion.values import TrackState, UserError, shown

DIGITS_MAX: Final = 20  # most digits of a 64-bit number
OPENING_S: Final = 1.0
"""Longest wait for links to open before the service reports that it is ready."""
STATUS_EVERY_S: Final = 5.0
"""Time between two status lines without a watchdog."""
LATE_AGAIN: Final = 0.05
"""Fraction of the watchdog's period after which late updates are checked again.

A short delay at the moment of a keep-alive then does not cause a restart.
"""


class Manager:
    """The service manager's socket.

    ``watchdog_s`` is the longest allowed silence; None: unlimited. Raises ``UserError`` for an
    address that is neither a path nor an abstract name (``@NAME``).
    """

    def __init__(self, address: str, watchdog_s: float | None = None) -> None:
        if not address.startswith(("/", "@")) or len(address) < 2:
            raise UserError(f"NOTIFY_SOCKET: {address!r} is neither /PATH nor @NAME")
        # An abstract name begins with a zero byte on the wire, written @ (unix(7)).
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self.watchdog_s = watchdog_s

    def tell(self, *lines: str) -> str | None:
        """Send one message to the service manager. Returns an error text or None. Never blocks."""
        message = "\n".join(lines).encode()
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as out:
                out.setblocking(False)
                out.sendto(message, self._address)
        except OSError as error:
            return error.strerror or str(error)
        return None


def manager(environ: Mapping[str, str]) -> Manager | None:
    """Return the service manager that started this process; None without one.

    Raises ``UserError`` for invalid environment variables.
    """
    address = environ.get("NOTIFY_SOCKET")
    return Manager(address, _watchdog_s(environ)) if address else None


def _watchdog_s(environ: Mapping[str, str]) -> float | None:
    pid, usec = environ.get("WATCHDOG_PID"), environ.get("WATCHDOG_USEC")
    if usec is None or (pid is not None and pid != str(os.getpid())):
        return None  # not requested, or for another process
    if not (usec.isdecimal() and len(usec) <= DIGITS_MAX and int(usec)):
        raise UserError(f"WATCHDOG_USEC: {shown(usec)} is not a positive number of microseconds")
    return int(usec) * 1e-6


async def keep_informed(
    manager: Manager, service: Service, say: Callable[[str], None], until: asyncio.Event
) -> None:
    """Notify the service manager that the service is ready, then alive, and at last that it stops.

    Ready means that HTTP answers and every link is open, with or without a peer. Returns when
    ``until`` is set. A message that cannot be sent is reported once.
    """
    await service.answering.wait()
    loop = asyncio.get_running_loop()
    open_by_s = loop.time() + OPENING_S
    while loop.time() < open_by_s and any(link.state != "up" for link in service.links()):
        await pause(until, OPENING_S / 50)
    ready = failing = False
    while not until.is_set():
        late = service.updates_late()
        signs = ["READY=1"] * (not ready) + ["WATCHDOG=1"] * (not late)
        trouble = manager.tell(*signs, f"STATUS={status_line(service)}")
        ready = ready or trouble is None
        if trouble and not failing:
            say(f"systemd cannot be notified: {trouble}")
        failing = trouble is not None
        await pause(until, _wait_s(manager.watchdog_s, late or failing))
    manager.tell("STOPPING=1", "STATUS=finishing the recording")


def _wait_s(watchdog_s: float | None, again: bool) -> float:
    """Return the time to the next message: half the watchdog's (sd_watchdog_enabled(3))."""
    if watchdog_s is None:
        return STATUS_EVERY_S
    return watchdog_s * (LATE_AGAIN if again else 0.5)


def status_line(service: Service) -> str:
    """Return a status line for the operator: UAVs by state, links, the recording."""
    update, links = service.pipeline.last_update, service.links()
    states = Counter(track.state for track in update.tracks) if update else Counter()
    uavs = ", ".join(f"{states[state]} {state}" for state in TrackState if states[state])
    up = sum(link.state == "up" for link in links)
    late = "; beam updates are late" if service.updates_late() else ""
    return (
        f"UAVs: {uavs or 'none'}; links up: {up} of {len(links)};"
        f" recording: {service.recording().state}{late}"
    )
