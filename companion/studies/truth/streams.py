"""Reports, stamps and truth messages of each vehicle in a log, in order of arrival.

Truth messages come from the simulator: SIM_STATE, and ArduPilot's older SIMSTATE
(ardupilotmega.xml, 164), which has no altitude.
"""

import struct
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import compress
from pathlib import Path
from typing import Final

import numpy as np

from companion.mavlink.trust.dedupe import Dedupe
from companion.mavlink.wire.decode import GPS_RAW_INT, decode
from companion.mavlink.wire.positions import OWN
from companion.recording.reader import read_flight
from companion.studies.truth import stamps
from companion.studies.truth.hindsight import BootClock, boot_clock
from companion.studies.truth.pairing import Brackets
from companion.values import Frame, GnssStatus, Report, RoundTrip, UserError

_HOUR_NS: Final = 3_600_000_000_000
DURATION_MAX_NS: Final = 12 * _HOUR_NS
"""Longest flight that is studied: studies hold all of it, every update of pauses included."""
SIM_STATE: Final = 108
SIMSTATE: Final = 164
_LAYOUTS: Final = {SIM_STATE: struct.Struct("<21fii"), SIMSTATE: struct.Struct("<9fii")}
"""Fields of both: latitude and longitude in 1e-7 degrees last, in SIM_STATE a quaternion first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TruthMessage:
    """Truth message, which the simulator writes into the log."""

    arrival_ns: int
    before: int  # index of the stamp before it on its link, among the stamps of its vehicle
    after: int  # index of the stamp after it
    payload: bytes


@dataclass(slots=True)
class _Order:
    """Order of one vehicle's messages on one link: last stamp, truth messages since then."""

    last: int | None = None
    waiting: list[tuple[int, int, bytes]] = field(default_factory=list)  # msgid, arrival, payload


@dataclass(slots=True, kw_only=True)
class VehicleStream:
    """Messages of one vehicle in order of arrival.

    reports reports, without repeats
    report_at    index of each report among the frames
    gnss         last receiver status before each report
    frames       its frames, except truth messages
    round_trips TIMESYNC round trips
    stamps       arrival and boot time of its stamped messages, ns
    said         truth messages, by message id
    """

    reports: list[Report] = field(default_factory=list)
    report_at: list[int] = field(default_factory=list)
    gnss: list[GnssStatus | None] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)
    round_trips: list[RoundTrip] = field(default_factory=list)
    stamps: list[tuple[int, int]] = field(default_factory=list)
    said: dict[int, list[TruthMessage]] = field(
        default_factory=lambda: {SIM_STATE: [], SIMSTATE: []}
    )
    _newest: GnssStatus | None = None
    _links: dict[str, _Order] = field(default_factory=lambda: defaultdict(_Order))

    def clock(self) -> BootClock:
        """Estimate the vehicle's boot clock from all stamps."""
        rows = np.array(self.stamps, dtype=np.int64).reshape(-1, 2)
        return boot_clock(rows[:, 0], rows[:, 1])

    def take(self, frame: Frame, dedupe: Dedupe) -> None:
        """Add a frame of the vehicle; ``dedupe`` holds the reports of all vehicles."""
        order = self._links[frame.link]
        if frame.msgid in self.said:
            if order.last is not None:
                order.waiting.append((frame.msgid, frame.t_ns, frame.payload))
            return
        stamp_ms = stamps.boot_ms(frame)
        if stamp_ms is not None:
            self._stamped(frame.t_ns, stamp_ms * 1_000_000, order)
        if frame.msgid in OWN or frame.msgid == GPS_RAW_INT:
            self._decoded(frame, dedupe)
        self.frames.append(frame)

    def _stamped(self, t_ns: int, boot_ns: int, order: _Order) -> None:
        number = len(self.stamps)
        self.stamps.append((t_ns, boot_ns))
        for msgid, came_ns, payload in order.waiting:
            assert order.last is not None
            self.said[msgid].append(
                TruthMessage(arrival_ns=came_ns, before=order.last, after=number, payload=payload)
            )
        order.waiting.clear()
        order.last = number

    def _decoded(self, frame: Frame, dedupe: Dedupe) -> None:
        message = decode(frame)
        if isinstance(message, GnssStatus):
            self._newest = message
        elif isinstance(message, Report) and not dedupe.is_repeat(frame):
            self.reports.append(message)
            self.report_at.append(len(self.frames))
            self.gnss.append(self._newest)


@dataclass(frozen=True, slots=True, eq=False)
class TruthMessages:
    """Truth messages of one kind in stream order: brackets and fields."""

    brackets: Brackets
    fields: list[tuple[float, ...]]


def truth_messages(stream: VehicleStream, msgid: int, clock: BootClock) -> TruthMessages:
    """Return truth messages of one kind between two stamps that no reboot separates."""
    said = stream.said[msgid]
    before = np.array([each.before for each in said], dtype=np.int64)
    after = np.array([each.after for each in said], dtype=np.int64)
    found = Brackets(
        arrival_ns=np.array([each.arrival_ns for each in said], dtype=np.int64),
        before_ns=clock.boot_ns[before],
        after_ns=clock.boot_ns[after],
        before_arrival_ns=clock.arrival_ns[before],
        after_arrival_ns=clock.arrival_ns[after],
        life=clock.life[before],
    )
    kept = (clock.life[before] == clock.life[after]) & (found.after_ns >= found.before_ns)
    layout = _LAYOUTS[msgid]
    decoded = [
        layout.unpack(each.payload.ljust(layout.size, b"\0")[: layout.size])
        for each in compress(said, kept.tolist())
    ]
    return TruthMessages(found.rows(kept), decoded)


def gather(logs: Sequence[Path]) -> dict[str, VehicleStream]:
    """Return the streams of a flight's logs, by vehicle that reports a position.

    Raises ``UserError`` for logs of more than ``DURATION_MAX_NS``.
    """
    found: dict[str, VehicleStream] = defaultdict(VehicleStream)
    dedupe, first_ns = Dedupe(), None
    for event in read_flight(logs):
        first_ns = event.t_ns if first_ns is None else first_ns
        if event.t_ns - first_ns > DURATION_MAX_NS:
            limit = f"{DURATION_MAX_NS // _HOUR_NS} hours, the limit of studies"
            raise UserError(f"{logs[0]}: the flight is longer than {limit}; give a part of it")
        if isinstance(event, RoundTrip):
            found[str(event.source)].round_trips.append(event)
        elif isinstance(event, Frame):
            found[str(event.source)].take(event, dedupe)
    return {name: stream for name, stream in found.items() if stream.reports}
