"""The loop that takes beams at the update rate and applies them to a device.             [shell]

It runs on a thread of its own and asks for beams that are right when the device will have them: the
lead is the time from asking to being applied, as it was of late, or the lag that a mount shows by
itself.
"""

import statistics
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Protocol

import numpy as np

from companion.values import IntArray, UserError

REMEMBERED: Final = 1000  # updates of which times are kept
LEADING: Final = 51  # updates whose median time is the next one's lead
RETRY_NS: Final = 1_000_000_000  # time between two attempts to reach a device
LATE_SHARE: Final = 0.1
"""Share of the time between two updates by which one may come after its moment."""


class SafeState(StrEnum):
    """State of a device while there is nothing to apply, and at the end."""

    HOLD = "hold"
    BORESIGHT = "boresight"
    MUTE = "mute"


class DeviceInput(StrEnum):
    """The part of an update that a device applies."""

    POINTING = "pointing"
    REGISTERS = "adar1000"
    STORED = "stored"


class DeviceError(Exception):
    """A device that failed, or that cannot be reached; it is tried again."""


class SourceLostError(Exception):
    """A service that does not answer."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class DeviceCommand:
    """What is to be applied.

    place        of the UAV: latitude and longitude in degrees, height above mean sea level in
                 metres; None where it is not known
    registers    (M, 8), as the text for ADAR1000 has them: chip, channel, element, phase code,
                 gain code, attenuator, I and Q; None where nobody asked
    """

    valid_at_ns: int  # for when it is right
    unfit: str | None  # why there is nothing to apply; None: there is
    uav: str = ""  # who is served
    bearing_rad: float = 0.0  # from true north, clockwise
    above_rad: float = 0.0  # above the horizon
    place: tuple[float, float, float] | None = None
    registers: IntArray | None = None
    stored: int | None = None  # index of the codebook's best beam; None where nobody asked


class BeamSource(Protocol):
    """Where beams come from."""

    def ask(self, lead_s: float) -> DeviceCommand:
        """What is to be applied so long from now. Raises ``SourceLostError``."""


class Device(Protocol):
    """What beams are applied to. Every method may raise ``DeviceError``.

    lead_s  lag that the device shows by itself; None: the time to apply is all
    """

    takes: DeviceInput  # what a command needs to hold

    @property
    def lead_s(self) -> float | None: ...
    def check(self, safe: SafeState) -> None:
        """Raise ``UserError`` for a safe state that the device does not have."""

    def open(self) -> None: ...
    def apply(self, command: DeviceCommand) -> None: ...
    def rest(self, safe: SafeState) -> None:
        """Go to a safe state."""

    def close(self) -> None:
        """Let go of the device; raises nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveStatus:
    """How it goes.

    p50_ms, p99_ms time from asking to applied; None before there is one
    """

    applied: int  # updates that the device has taken
    rate_hz: float | None  # of late; None before there is one
    p50_ms: float | None
    p99_ms: float | None
    lead_ms: float  # what is asked ahead now
    late: int  # updates that were applied after their moment
    skipped: int  # moments that were left out, since the device was not ready
    failures: int  # of the device; each is followed by a new attempt
    resting: str | None  # why there is nothing to apply; None: there is


class Drive:
    """One device, driven.

    ``say`` gets a line whenever something changes. Raises ``UserError`` for a safe state that the
    device does not have.
    """

    def __init__(
        self,
        *,
        source: BeamSource,
        device: Device,
        update_hz: float,
        safe: SafeState,
        now_ns: Callable[[], int],
        say: Callable[[str], None],
    ) -> None:
        device.check(safe)
        self._source = source
        self._device = device
        self._period_ns = round(1e9 / update_hz)
        self._safe = safe
        self._now_ns = now_ns
        self._say = say
        self._open = False
        self._again_ns = 0
        self._resting: str | None = None
        self._took_ns: deque[int] = deque(maxlen=REMEMBERED)
        self._at_ns: deque[int] = deque(maxlen=REMEMBERED)
        self._applied = self._late = self._skipped = self._failures = 0

    def run(self, stop: threading.Event) -> None:
        """Apply updates until ``stop`` is set; then leave the device in its safe state."""
        due_ns = self._now_ns()
        try:
            while not stop.is_set():
                self.step()
                due_ns += self._period_ns
                behind = max(0, self._now_ns() - due_ns) // self._period_ns
                self._skipped += behind
                due_ns += behind * self._period_ns
                stop.wait(max(0, due_ns - self._now_ns()) * 1e-9)
        finally:
            self.end()

    def step(self) -> None:
        """Take one update and apply it, or go to the safe state where there is none."""
        try:
            if not self._reached():
                return
            began_ns = self._now_ns()
            try:
                command = self._source.ask(self.lead_s)
            except SourceLostError as error:
                self._rest(f"the service is lost: {error}")
                return
            if command.unfit is not None:
                self._rest(command.unfit)
                return
            self._device.apply(command)
        except DeviceError as error:
            self._failed(error)
            return
        ended_ns = self._now_ns()
        self._took_ns.append(ended_ns - began_ns)
        self._at_ns.append(ended_ns)
        self._applied += 1
        if self._device.lead_s is None:  # a mount is behind by nature, and led by its lag
            self._late += ended_ns > command.valid_at_ns + LATE_SHARE * self._period_ns
        if self._resting is not None:
            self._resting = None
            self._say("beams are applied")

    def end(self) -> None:
        """Leave the device in its safe state, and let go of it."""
        if self._open:
            try:
                self._device.rest(self._safe)
            except DeviceError as error:
                self._say(f"the device did not go to its safe state: {error}")
            self._device.close()
            self._open = False

    @property
    def lead_s(self) -> float:
        """How far ahead beams are asked for."""
        own_s = self._device.lead_s
        if own_s is not None:
            return own_s
        return statistics.median(list(self._took_ns)[-LEADING:]) * 1e-9 if self._took_ns else 0.0

    def status(self) -> DriveStatus:
        """How it goes."""
        took, at = np.array(self._took_ns) * 1e-6, list(self._at_ns)
        spent_s = (at[-1] - at[0]) * 1e-9 if len(at) > 1 else 0.0
        return DriveStatus(
            applied=self._applied,
            rate_hz=(len(at) - 1) / spent_s if spent_s > 0 else None,
            p50_ms=float(np.percentile(took, 50)) if took.size else None,
            p99_ms=float(np.percentile(took, 99)) if took.size else None,
            lead_ms=self.lead_s * 1e3,
            late=self._late,
            skipped=self._skipped,
            failures=self._failures,
            resting=self._resting,
        )

    def _reached(self) -> bool:
        """Whether the device is open; it is tried again once in a while."""
        if not self._open and self._now_ns() >= self._again_ns:
            self._device.open()
            self._open = True
            self._say("the device is reached")
        return self._open

    def _failed(self, error: DeviceError) -> None:
        if self._open or not self._failures:
            self._say(f"the device failed: {error}")
        self._failures += 1
        self._resting = None  # what it does once it is back is not known
        self._device.close()
        self._open = False
        self._again_ns = self._now_ns() + RETRY_NS

    def _rest(self, why: str) -> None:
        """Go to the safe state, once for each reason."""
        if self._resting != why:
            if self._resting is None:
                self._device.rest(self._safe)
            self._resting = why
            self._say(f"{self._safe}: {why}")


def require(safe: SafeState, allowed: tuple[SafeState, ...], device: str) -> None:
    """Raise ``UserError`` for a safe state that a device does not have."""
    if safe not in allowed:
        raise UserError(f"{device} can {' or '.join(allowed)}, not {safe}")
