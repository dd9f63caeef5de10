"""The loop that fetches beams at the update rate and applies them to a device.

It runs on its own thread and requests beams for the time at which the device will have applied
them. The lead is the recent median time from request to application, or the lag that a mount
reports.

Over 300 lines: the loop, and the interfaces of what it connects.
"""

import contextlib
import statistics
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType
from typing import Final, Protocol

import numpy as np

from companion.values import IntArray, Severity, UserError, printable, text_of

REMEMBERED: Final = 1000  # updates whose times are kept
LEAD_UPDATES: Final = 51  # updates whose median time is the next lead
RETRY_NS: Final = 1_000_000_000  # time between two attempts to open a device
SLOW_NS: Final = 5_000_000_000  # duration of an update after which it is reported
STEADY_NS: Final = 5_000_000_000  # time without a failure after which a recovery is reported
TEXT_MAX: Final = 200  # longest text that is reported, characters
LATE_SHARE: Final = 0.1
"""Fraction of the update interval by which an update may be late."""


class SafeState(StrEnum):
    """Safe state of a device, for when there are no beams, and after the end."""

    HOLD = "hold"
    BORESIGHT = "boresight"
    MUTE = "mute"


class DeviceInput(StrEnum):
    """Kind of data that a device applies from an update."""

    POINTING = "pointing"
    REGISTERS = "adar1000"
    STORED = "stored"


class DeviceError(Exception):
    """Failure of a device, or an unreachable device; the operation is retried."""


@contextlib.contextmanager
def library_errors(device: str) -> Iterator[None]:
    """Raise ``DeviceError`` for whatever the library of a device raises, and for its exits.

    Libraries raise plain exceptions, and those of their own parsing of a reply. On the main thread
    ``KeyboardInterrupt`` is the user's Ctrl-C, and is raised unchanged.
    """
    try:
        yield
    except BaseException as error:
        is_main = threading.current_thread() is threading.main_thread()
        if is_main and isinstance(error, KeyboardInterrupt):
            raise
        cause = error.strerror if isinstance(error, OSError) else None
        raise DeviceError(f"{device}: {cause or text_of(error)}") from error


class SourceLostError(Exception):
    """Error of a service that does not answer."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class DeviceCommand:
    """Command that a drive sends to a device.

    place        position of the UAV: latitude and longitude in degrees, height above mean sea level
                 in metres; None if unknown
    registers    (M, 8), as in the text for ADAR1000: chip, channel, element, phase code,
                 gain code, attenuator, I and Q; None if not requested
    """

    valid_at_ns: int  # time for which it is computed
    unfit: str | None  # why there is nothing to apply; None: there is a beam
    uav: str = ""  # UAV that is served
    bearing_rad: float = 0.0  # from true north, clockwise
    above_rad: float = 0.0  # above the horizon
    place: tuple[float, float, float] | None = None
    registers: IntArray | None = None
    stored: int | None = None  # index of the codebook's best beam; None if not requested


class BeamSource(Protocol):
    """Source of beams for a device."""

    def ask(self, lead_s: float) -> DeviceCommand:
        """Return the device command for ``lead_s`` seconds from now. Raises ``SourceLostError``."""


class Device(ABC):
    """Device to which beams are applied. Every method may raise ``DeviceError``.

    rejected  replies that could not be used but were not needed, by reason
    """

    name = "a device"  # in messages
    takes: DeviceInput  # required content of a command
    safe_states: tuple[SafeState, ...] = tuple(SafeState)  # those that it supports
    rejected: Mapping[str, int] = MappingProxyType({})

    @property
    def lead_s(self) -> float | None:
        """Lag that the device itself shows; None: only the time to apply counts."""
        return None

    def check(self, safe: SafeState) -> None:
        """Raise ``UserError`` for a safe state that the device does not support."""
        if safe not in self.safe_states:
            choice = " or ".join(self.safe_states)
            raise UserError(f"{self.name} does not support {safe}; choose {choice}")

    @abstractmethod
    def open(self) -> None:
        """Connect to the device."""

    @abstractmethod
    def apply(self, command: DeviceCommand) -> None:
        """Apply a command."""

    @abstractmethod
    def rest(self, safe: SafeState) -> None:
        """Put the device into a safe state."""

    @abstractmethod
    def close(self) -> None:
        """Close the device; raises nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveStatus:
    """State of a driven device.

    p50_ms, p99_ms time from request to application; None before the first
    """

    applied: int  # updates that were applied
    rate_hz: float | None  # recent rate of updates; None before the second
    p50_ms: float | None
    p99_ms: float | None
    lead_ms: float  # current lead of requests
    late: int  # updates that were applied too late
    skipped: int  # updates that were skipped because the device was not ready
    failures: int  # failures of the device, each followed by a new attempt
    rejected: dict[str, int]  # replies of the device that could not be used, by reason
    resting: str | None  # why there is nothing to apply; None: there is a beam


class Drive:
    """Loop that drives one device.

    ``say`` gets a line for each change, and its severity. Raises ``UserError`` for a safe state
    that the device does not support.
    """

    def __init__(
        self,
        *,
        source: BeamSource,
        device: Device,
        update_hz: float,
        safe: SafeState,
        now_ns: Callable[[], int],
        say: Callable[[str, Severity], None],
    ) -> None:
        device.check(safe)
        self._source = source
        self._device = device
        self._period_ns = round(1e9 / update_hz)
        self._safe = safe
        self._now_ns = now_ns
        self._report = say
        self._open = False
        self._stop = threading.Event()
        self._again_ns = 0
        self._resting: str | None = None
        self._reported_state = ""  # whether beams are applied, or why not
        self.device_error: str | None = None  # why the device does not work
        self._is_failure_reported = False
        self._works_since_ns = 0  # since when a device has worked again whose failure was reported
        self.service_error: str | None = None  # why the service gives no beams
        self._took_ns: deque[int] = deque(maxlen=REMEMBERED)
        self._at_ns: deque[int] = deque(maxlen=REMEMBERED)
        self._applied = self._late = self._skipped = self._failures = 0
        self._waits: tuple[int, str] | None = None  # since when, and for what an update waits
        self._reported_wait: tuple[int, str] | None = None
        self._reported_rejections: set[str] = set()

    def run(self, stop: threading.Event) -> None:
        """Apply updates until ``stop`` is set; then put the device into its safe state."""
        due_ns, self._stop = self._now_ns(), stop
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
        """Fetch one update and apply it; without an update, go to the safe state."""
        try:
            self._step()
        finally:
            self._waits = None

    def report_wait(self) -> None:
        """Report once that an update waits for more than 5 s; for calls on another thread.

        Libraries of devices have no timeout for a whole answer.
        """
        waits = self._waits
        if waits is None or waits == self._reported_wait:
            return
        if self._now_ns() - waits[0] > SLOW_NS:
            self._reported_wait = waits
            self._warn(
                f"{waits[1]} has not answered for {SLOW_NS // 1_000_000_000} s; still waiting"
            )

    def _step(self) -> None:
        try:
            self._waits = self._now_ns(), "the device"
            if not self._reached():
                return
            began_ns = self._now_ns()
            try:
                self._waits = began_ns, "the service"
                command = self._source.ask(self.lead_s)
                self._waits = self._now_ns(), "the device"
                self.service_error = None
            except SourceLostError as error:
                self.service_error = str(error)
                self._rest(f"no answer from the service: {error}")
                return
            if command.unfit is not None:
                self._rest(command.unfit)
                return
            if self._stop.is_set():
                return
            self._device.apply(command)
            self._note_success()
        except DeviceError as error:
            self._handle_failure(error)
            return
        for reason in self._device.rejected.keys() - self._reported_rejections:
            self._reported_rejections.add(reason)
            self._say(f"a reply of the device is rejected ({reason}); others are only counted")
        ended_ns = self._now_ns()
        self._took_ns.append(ended_ns - began_ns)
        self._at_ns.append(ended_ns)
        self._applied += 1
        if self._device.lead_s is None:  # a mount always lags, and its lag is compensated
            self._late += ended_ns > command.valid_at_ns + LATE_SHARE * self._period_ns
        if self._resting is not None:
            self._resting = None
            self._report_state("beams are applied")

    def report_unsafe(self) -> None:
        """Report that the device was left as it is; for calls on another thread."""
        self._warn("the device has not answered: it may not be in its safe state")

    def end(self) -> None:
        """Put the device into its safe state, and close it."""
        if self._open:
            try:
                self._device.rest(self._safe)
            except DeviceError as error:
                self._warn(f"the device did not go to its safe state: {error}")
            self._device.close()
            self._open = False
        elif self.device_error is not None:
            self._warn(f"the device did not go to its safe state: {self.device_error}")

    @property
    def lead_s(self) -> float:
        """Lead of the next request: how far ahead its beams are computed, seconds."""
        own_s = self._device.lead_s
        if own_s is not None:
            return own_s
        return (
            statistics.median(list(self._took_ns)[-LEAD_UPDATES:]) * 1e-9 if self._took_ns else 0.0
        )

    def status(self) -> DriveStatus:
        """Return the state of the drive."""
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
            rejected=dict(self._device.rejected),
            resting=self._resting,
        )

    def _say(self, text: str, severity: Severity = Severity.INFO) -> None:
        """Report a change, with what a device or a service wrote into it, in one line."""
        self._report(printable(" ".join(text.split()))[:TEXT_MAX], severity)

    def _warn(self, text: str) -> None:
        self._say(text, Severity.WARNING)

    def _report_state(self, text: str) -> None:
        """Report what is applied, unless that is what was reported last."""
        if text != self._reported_state:
            self._reported_state = text
            self._say(text)

    def _reached(self) -> bool:
        """Return whether the device is open; at intervals, try to open it."""
        if not self._open and self._now_ns() >= self._again_ns:
            self._device.open()
            self._open = True
            if not self._is_failure_reported:
                self._say("the device is connected")
        return self._open

    def _note_success(self) -> None:
        """Note that the device accepted something; report a recovery once it has lasted.

        That it can be opened shows nothing: over UDP it may be absent.
        """
        if self.device_error is not None:
            self.device_error, self._works_since_ns = None, self._now_ns()
        if self._is_failure_reported and self._now_ns() - self._works_since_ns >= STEADY_NS:
            self._is_failure_reported = False
            self._say("the device is connected")

    def _handle_failure(self, error: DeviceError) -> None:
        if not self._is_failure_reported:
            self._is_failure_reported = True
            self._warn(f"the device failed: {error}")
        self._failures += 1
        self.device_error = str(error)
        self._ask_anyway()
        self._resting = None  # its state after a reconnection is unknown
        self._device.close()
        self._open = False
        self._again_ns = self._now_ns() + RETRY_NS

    def _ask_anyway(self) -> None:
        """Report a service that does not answer either, so that both faults are known at once."""
        before = self.service_error
        try:
            self._source.ask(0.0)
            self.service_error = None
        except SourceLostError as error:
            self.service_error = str(error)
            if before != self.service_error:
                self._warn(f"no answer from the service: {error}")

    def _rest(self, why: str) -> None:
        if self._resting != why:
            if self._resting is None:
                self._device.rest(self._safe)
                self._note_success()
            self._resting = why
            self._report_state(f"{self._safe}: {why}")
