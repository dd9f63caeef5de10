"""Causes of weak links: one input is disturbed, or two at once, and the verdicts name it.

Four UAVs circle a carrier; all links are good. Then an input is starved, delayed, silenced or
degraded. Within two seconds, 95 of 100 verdicts that are not good name its cause.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import pytest
from pymavlink.dialects.v20 import all as dialect
from sent_frames import START_NS, S, attitude, position, sent

from companion.pipeline.fold import Pipeline
from companion.settings.model import Settings
from companion.values import (
    Cause,
    Event,
    Frame,
    Level,
    Reason,
    Rejection,
    RoundTrip,
    Source,
    Tick,
    Update,
)

UAVS: Final = ("1:1", "2:1", "3:1", "4:1")
CARRIER: Final = "5:1"
GOOD_S: Final = 8.0  # the disturbance begins after this time
LASTS_S: Final = 8.0
WITHIN_S: Final = 2.0
SHARE: Final = 0.95
HZ: Final = 10

Change = Callable[[float, Frame], Frame | None]
"""What becomes of a frame sent at a time; its time is that of its arrival. None: lost."""


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """Disturbance of one input.

    change  what becomes of frames
    stall   time for which this machine reads nothing, of each ``period`` seconds
    struck  senders that it concerns
    cause   cause that the verdicts on UAVs must name
    word    what the reason must contain
    """

    change: Change = lambda _, frame: frame
    stall: tuple[float, float] | None = None
    struck: frozenset[str]
    cause: Cause
    word: str = ""


def _is_of(frame: Frame, sender: str, *names: str) -> bool:
    ids = {getattr(dialect, f"MAVLINK_MSG_ID_{name}") for name in names}
    return str(frame.source) == sender and (not ids or frame.msgid in ids)


def _lost(sender: str, *names: str) -> Change:
    return lambda _, frame: None if _is_of(frame, sender, *names) else frame


def _late(sender: str, seconds: float) -> Change:
    def change(_: float, frame: Frame) -> Frame:
        late_ns = round(seconds * S) if _is_of(frame, sender) else 0
        return frame._replace(t_ns=frame.t_ns + late_ns)

    return change


def _sparse(sender: str, every_s: float) -> Change:
    def change(at_s: float, frame: Frame) -> Frame | None:
        is_kept = round(at_s * HZ) % round(every_s * HZ) == 0
        return frame if is_kept or not _is_of(frame, sender, "GLOBAL_POSITION_INT") else None

    return change


def _frozen(sender: str) -> Change:
    """The position stands still while the velocity, and the stamp, go on."""

    def change(at_s: float, frame: Frame) -> Frame:
        if not _is_of(frame, sender, "GLOBAL_POSITION_INT"):
            return frame
        return replace_position(at_s, sender, *place(sender, GOOD_S))

    return change


def _uncertain_compass(at_s: float, frame: Frame) -> Frame:
    """The autopilot reports a compass that does not fit its gyroscopes."""
    if not _is_of(frame, CARRIER, "EKF_STATUS_REPORT"):
        return frame
    return status(at_s, compass=0.8)


def _inaccurate(sender: str) -> Change:
    def change(at_s: float, frame: Frame) -> Frame:
        if not _is_of(frame, sender, "GPS_RAW_INT"):
            return frame
        return receiver(at_s, sender, accuracy_m=25.0)

    return change


ALL: Final = frozenset(UAVS)
DISTURBANCES: Final = {
    "starved": Disturbance(stall=(1.2, 1.4), struck=ALL, cause=Cause.MACHINE, word="overloaded"),
    "silent": Disturbance(
        change=_lost("1:1"), struck=frozenset({"1:1"}), cause=Cause.SILENT, word="no report"
    ),
    "delayed": Disturbance(
        change=_late("2:1", 1.2), struck=frozenset({"2:1"}), cause=Cause.LATE, word="late"
    ),
    "sparse": Disturbance(
        change=_sparse("3:1", 3.0), struck=frozenset({"3:1"}), cause=Cause.RATE, word="apart"
    ),
    "frozen": Disturbance(
        change=_frozen("4:1"), struck=frozenset({"4:1"}), cause=Cause.REFUSED, word="frozen"
    ),
    "compass": Disturbance(
        change=_uncertain_compass, struck=ALL, cause=Cause.CARRIER, word="uncertain"
    ),
    "attitude lost": Disturbance(
        change=_lost(CARRIER, "ATTITUDE"), struck=ALL, cause=Cause.CARRIER, word="attitude"
    ),
    "carrier lost": Disturbance(
        change=_lost(CARRIER), struck=ALL, cause=Cause.CARRIER, word="carrier"
    ),
    "inaccurate": Disturbance(
        change=_inaccurate("1:1"), struck=frozenset({"1:1"}), cause=Cause.POSITION, word="position"
    ),
}


def place(uav: str, at_s: float) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    number = int(uav[0])
    if uav == CARRIER:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    angle = math.tau * number / 12 - 0.5 + 0.05 * at_s
    speed = 120.0 * 0.05
    return (
        (250.0 + 120.0 * math.cos(angle), -150.0 + 80.0 * number + 120.0 * math.sin(angle), -60.0),
        (-speed * math.sin(angle), speed * math.cos(angle), 0.0),
    )


def replace_position(
    at_s: float,
    sender: str,
    ned_m: tuple[float, float, float],
    velocity_mps: tuple[float, float, float],
) -> Frame:
    return position(at_s, sender, ned_m, velocity_mps, seq=round(at_s * 50) % 256)


def receiver(at_s: float, sender: str, accuracy_m: float) -> Frame:
    message = dialect.MAVLink_gps_raw_int_message(
        round(1e6 * (100 + at_s)), 3, 0, 0, 500000, 80, 120, 0, 65535, 12,
        h_acc=round(1e3 * accuracy_m), v_acc=round(1e3 * accuracy_m), vel_acc=300,
    )  # fmt: skip
    return sent(at_s, sender, message, seq=round(at_s * 50 + 3) % 256)


def status(at_s: float, compass: float) -> Frame:
    message = dialect.MAVLink_ekf_status_report_message(831, 0.1, 0.1, 0.1, compass, 0.0)
    return sent(at_s, CARRIER, message, seq=round(at_s * 50 + 7) % 256)


def honest(seconds: float) -> Iterator[tuple[float, Frame]]:
    """Yield frames with the times at which they are sent: 20 ms before they arrive."""
    for step in range(round(seconds * HZ)):
        for index, sender in enumerate((*UAVS, CARRIER)):
            at_s = (step + index / 5) / HZ
            yield at_s, replace_position(at_s, sender, *place(sender, at_s))
            yield at_s, receiver(at_s, sender, accuracy_m=0.4)
            if sender == CARRIER:
                yield at_s, attitude(at_s, CARRIER, 0.0, 0.0, 0.0)
                yield at_s, status(at_s, compass=0.05)


def round_trips(seconds: float) -> Iterator[RoundTrip]:
    """Yield TIMESYNC round trips of 10 ms, one a second for each sender."""
    for at_s in range(round(seconds)):
        for index, sender in enumerate((*UAVS, CARRIER)):
            sent_ns = START_NS + round((at_s + 0.1 * index) * S)
            yield RoundTrip(
                t_ns=sent_ns + S // 100,
                source=Source.parse(sender),
                sent_ns=sent_ns,
                remote_ns=round(100 * S) + sent_ns - START_NS + S // 200,
            )


def flown(disturbances: list[Disturbance], lasts_s: float = LASTS_S) -> list[Event]:
    """Return the events: frames and round trips as this machine reads them, and its ticks."""
    seconds = GOOD_S + lasts_s
    arriving = list[Event](round_trips(seconds))
    for at_s, frame in honest(seconds):
        kept: Frame | None = frame
        for one in disturbances:
            if at_s >= GOOD_S and kept is not None:
                kept = one.change(at_s, kept)
        if kept is not None:
            arriving.append(kept)
    stalls = [one.stall for one in disturbances if one.stall]
    read = [(_read_s(event.t_ns, stalls), index, event) for index, event in enumerate(arriving)]
    ticks = [START_NS + round(n / HZ * S) for n in range(5, round(seconds * HZ))]
    for t_ns in ticks:
        due_ns = _read_s(t_ns, stalls)
        # What arrived last is read after the tick that was due meanwhile.
        waited_ns = due_ns - t_ns
        read.append((due_ns - (waited_ns > 0), -1, Tick(due_ns, waited_ns=waited_ns)))
    return [event for _, _, event in sorted(read, key=lambda one: one[:2])]


def _read_s(t_ns: int, stalls: list[tuple[float, float]]) -> int:
    """Return when this machine reads what arrives at a time."""
    for stalled_s, period_s in stalls:
        since_ns = t_ns - START_NS - round(GOOD_S * S)
        into_ns = since_ns % round(period_s * S)
        if since_ns >= 0 and into_ns < round(stalled_s * S):
            return t_ns - into_ns + round(stalled_s * S)
    return t_ns


def causes(disturbances: list[Disturbance]) -> tuple[Pipeline, dict[str, list[tuple[float, str]]]]:
    """Return the verdicts that are not good: for each UAV the times, and cause and reason."""
    pipeline = Pipeline(SETTINGS)
    found: dict[str, list[tuple[float, str]]] = {uav: [] for uav in UAVS}
    for event in flown(disturbances):
        updates = [one for one in pipeline.step(event) if isinstance(one, Update)]
        at_s = (event.t_ns - START_NS) / S
        for uav, verdict in pipeline.health.verdicts.items() if updates else ():
            if at_s < GOOD_S - 1e-6:
                continue
            if verdict.level is not Level.GOOD:
                assert verdict.blame is not None
                found[uav].append((at_s, f"{verdict.blame.cause}: {verdict.blame.reason}"))
    return pipeline, found


SETTINGS: Final = Settings().override(
    center={"source": CARRIER},
    observer={"lag_s": (0.0, 0.0), "acceleration_max_mps2": 15.0, "speed_max_mps": 60.0},
    link={"needed_db": 4.0},
)


def test_all_links_are_good_without_a_disturbance() -> None:
    pipeline, found = causes([])
    assert [verdict.level for verdict in pipeline.health.verdicts.values()] == [Level.GOOD] * 4
    assert not any(found.values())


def held_to(names: tuple[str, ...]) -> None:
    """Require that the verdicts on the struck UAVs name the cause of one of the disturbances."""
    chosen = [DISTURBANCES[name] for name in names]
    _, found = causes(chosen)
    for uav in UAVS:
        wanted = [one for one in chosen if uav in one.struck]
        seen = [text for at_s, text in found[uav] if at_s >= GOOD_S + WITHIN_S]
        if not wanted:
            assert not found[uav], (uav, found[uav][:3])
            continue
        right = [
            text
            for text in seen
            if any(text.startswith(f"{one.cause}: ") and one.word in text for one in wanted)
        ]
        assert seen, f"{uav} stays good"
        assert len(right) >= SHARE * len(seen), (uav, [one for one in seen if one not in right][:3])


def test_frozen_uav_is_rejected_not_silent_when_it_has_lost_its_beam() -> None:
    pipeline = Pipeline(SETTINGS)
    for event in flown([DISTURBANCES["frozen"]], 20.0):
        pipeline.step(event)
    verdict = pipeline.health.verdicts["4:1"]
    assert verdict.needed_gain_db is None  # no beam
    assert verdict.blame is not None
    assert verdict.blame.cause is Cause.REFUSED


def test_uav_whose_frames_this_machine_drops_is_not_called_silent() -> None:
    """Its radio was named as the cause."""
    pipeline, blames = Pipeline(SETTINGS), set[str]()
    dropped_ns = START_NS + round(GOOD_S * S)
    for event in flown([Disturbance(change=_lost("4:1"), struck=ALL, cause=Cause.MACHINE)], 20.0):
        pipeline.step(event)
        if event.t_ns - dropped_ns >= S // 2:
            dropped_ns = event.t_ns
            count = HZ // 2
            pipeline.step(
                Rejection(t_ns=dropped_ns, source="4:1", reason=Reason.NEWCOMER, count=count)
            )
        if event.t_ns > START_NS + (GOOD_S + WITHIN_S) * S:
            blames.add(str(pipeline.health.verdicts["4:1"].blame))
    (blame,) = blames
    assert "drops its reports" in blame and "MACHINE" in blame


def test_rejected_carrier_is_not_called_silent() -> None:
    def scattered(at_s: float, frame: Frame) -> Frame:
        if not _is_of(frame, CARRIER, "GLOBAL_POSITION_INT"):
            return frame
        east_m = 1000.0 * (2 + round(at_s * HZ) % 7)
        return replace_position(at_s, CARRIER, (0.0, east_m, 0.0), (0.0, 0.0, 0.0))

    struck = Disturbance(change=scattered, struck=ALL, cause=Cause.CARRIER)
    _, found = causes([struck])
    late = [text for at_s, text in found["1:1"] if at_s >= GOOD_S + WITHIN_S]
    assert "carrier: the carrier's positions are rejected: unreachable" in late
    assert not [text for text in late if "no position" in text]


@pytest.mark.parametrize("name", DISTURBANCES)
def test_disturbed_input_is_named(name: str) -> None:
    held_to((name,))


@pytest.mark.parametrize("names", list(combinations(DISTURBANCES, 2)), ids=" and ".join)
def test_one_of_two_disturbed_inputs_is_named(names: tuple[str, str]) -> None:
    held_to(names)
