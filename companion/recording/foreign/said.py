"""MAVLink frames that contain the samples of an onboard log.

Each sample is sent once, at its own time: ATTITUDE, GLOBAL_POSITION_INT, GPS_RAW_INT with its
accuracies, and SIM_STATE for the truth, directly after a stamped message of the same time if there
is one, which gives its time. HEARTBEAT and SYSTEM_TIME are sent once a second. Layouts:
https://mavlink.io/en/messages/common.html.
"""

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.mavlink.wire.encode import Outgoing, pack
from companion.recording.foreign.onboard import (
    Attitudes,
    Fixes,
    Onboard,
    OnboardPositions,
    Truth,
    euler_of,
)
from companion.recording.stamps import RepairedStamps
from companion.values import Event, FloatArray, Frame, IntArray, Reason, Rejection, Source

_EACH_US: Final = 1_000_000
_BLOCK: Final = 1 << 14
_PRESENCES_MAX: Final = 10 * 86_400
_ARMED: Final = 128
_ACTIVE: Final = 4
_HEARTBEAT: Final = np.dtype(
    [("mode", "<u4"), ("type", "u1"), ("autopilot", "u1"), ("base", "u1"), ("state", "u1"),
     ("version", "u1")]
)  # fmt: skip
_SYSTEM_TIME: Final = np.dtype([("unix_us", "<u8"), ("boot_ms", "<u4")])
_GPS_RAW_INT: Final = np.dtype(
    [("boot_us", "<u8"), ("place", "<i4", 3), ("dop", "<u2", 2), ("speed", "<u2"),
     ("course", "<u2"), ("fix", "u1"), ("satellites", "u1"), ("ellipsoid", "<i4"),
     ("accuracies", "<u4", 3), ("heading_accuracy", "<u4"), ("yaw", "<u2")]
)  # fmt: skip
_ATTITUDE: Final = np.dtype([("boot_ms", "<u4"), ("angles", "<f4", 3), ("rates", "<f4", 3)])
_POSITION: Final = np.dtype(
    [("boot_ms", "<u4"), ("place", "<i4", 4), ("velocity", "<i2", 3), ("heading", "<u2")]
)
_SIM_STATE: Final = np.dtype(
    [("quaternion", "<f4", 4), ("angles", "<f4", 3), ("motion", "<f4", 6), ("place", "<f4", 3),
     ("deviation", "<f4", 2), ("velocity", "<f4", 3), ("place_1e7", "<i4", 2)]
)  # fmt: skip

Payloads = NDArray[np.void]


class _Said(NamedTuple):
    """Frames of one message type, in order of time; at equal times the lower rank is first."""

    rank: int
    msgid: int
    boot_us: IntArray
    payloads: Payloads


def frames(log: Onboard, link: str, source: Source, latency_s: float) -> Iterator[Event]:
    """Yield the events of a log: rejections of unusable data, then its frames, in order of time.

        link       link of the frames
        source     sender of the frames
        latency_s  time from a sample to its arrival

    Without GPS time the timeline is the boot clock, from the epoch.
    """
    latency_ns = round(latency_s * 1e9)
    with np.errstate(all="ignore"):  # values out of range are clipped
        kinds = _kinds(log)
    order, boots = _in_order(kinds)
    unix_us = boots if log.clock is None else log.clock.unix_us(boots)
    times_ns = unix_us * 1000
    timeline = RepairedStamps(times_ns[:3].tolist())
    first_ns = timeline.t_ns + latency_ns
    for reason, count in log.lost.items():
        yield Rejection(t_ns=first_ns, source=link, reason=reason, count=count)
    tables = [(kind.msgid, kind.payloads.tobytes(), kind.payloads.itemsize) for kind in kinds]
    seq = 0
    for (kind, row), t_ns in _rows(order, times_ns):
        off_ns = timeline.place(t_ns)
        if off_ns is not None:
            side = "before" if off_ns < 0 else "after"
            detail = f"{abs(off_ns) / 1e9:.6g} s {side} the log's time; the log's time is used"
            yield Rejection(
                t_ns=timeline.t_ns + latency_ns, source=link, reason=Reason.BAD_STAMP, detail=detail
            )
        msgid, table, size = tables[kind]
        raw = pack(Outgoing(source, msgid, table[row * size : (row + 1) * size]), seq)
        seq = (seq + 1) & 0xFF
        yield Frame(t_ns=timeline.t_ns + latency_ns, link=link, source=source, msgid=msgid, raw=raw)


def _rows(order: IntArray, times_ns: IntArray) -> Iterator[tuple[tuple[int, int], int]]:
    """Yield (kind, row) and time of every message, in blocks."""
    for begin in range(0, len(order), _BLOCK):
        some = slice(begin, begin + _BLOCK)
        yield from zip(order[some].tolist(), times_ns[some].tolist(), strict=True)


def _in_order(kinds: list[_Said]) -> tuple[IntArray, IntArray]:
    """Return (kind, row) of every message in order of time, (N, 2), and boot times (N,).

    A boot clock that steps back within one kind was restarted; messages after that come last.
    """
    boots = np.concatenate([kind.boot_us for kind in kinds])
    lives = np.concatenate([_lives(kind.boot_us) for kind in kinds])
    number = np.repeat(np.arange(len(kinds)), [len(kind.boot_us) for kind in kinds])
    rows = np.concatenate([np.arange(len(kind.boot_us)) for kind in kinds])
    rank = np.array([kind.rank for kind in kinds])[number]
    order = np.lexsort((rank, boots, lives))
    return np.stack([number, rows], axis=1)[order], boots[order]


def _lives(boot_us: IntArray) -> IntArray:
    return np.cumsum(np.diff(boot_us, prepend=boot_us[:1]) < 0)


def _kinds(log: Onboard) -> list[_Said]:
    said = []
    if log.attitudes is not None:
        said.append(
            _Said(
                rank=3, msgid=30, boot_us=log.attitudes.boot_us, payloads=_attitudes(log.attitudes)
            )
        )
    if log.positions is not None:
        said.append(
            _Said(
                rank=4, msgid=33, boot_us=log.positions.boot_us, payloads=_positions(log.positions)
            )
        )
    if log.fixes is not None:
        said.append(_Said(rank=2, msgid=24, boot_us=log.fixes.boot_us, payloads=_fixes(log.fixes)))
    if log.truth is not None:
        said.append(
            _Said(rank=5, msgid=108, boot_us=log.truth.boot_us, payloads=_truths(log.truth))
        )
    seconds = _seconds([each.boot_us for each in said])
    said.append(_Said(rank=0, msgid=0, boot_us=seconds, payloads=_heartbeats(log, seconds)))
    if log.clock is not None:
        said.append(_Said(rank=1, msgid=2, boot_us=seconds, payloads=_system_times(log, seconds)))
    return said


def _seconds(times: list[IntArray]) -> IntArray:
    """Return the first time of any message in each second of the boot clock, by boot."""
    every = np.concatenate([np.zeros(0, dtype=np.int64), *times])
    lives = np.concatenate([np.zeros(0, dtype=np.int64), *map(_lives, times)])
    order = np.lexsort((every, lives))
    every, second = every[order], every[order] // _EACH_US
    found: IntArray = every[np.diff(second, prepend=-1) != 0][:_PRESENCES_MAX]
    return found


def _heartbeats(log: Onboard, boot_us: IntArray) -> Payloads:
    made = np.zeros(len(boot_us), dtype=_HEARTBEAT)
    made["type"], made["autopilot"] = log.mav_type, log.autopilot
    made["state"], made["version"] = _ACTIVE, 3
    if log.armed:
        from_us, armed = np.array(log.armed, dtype=np.int64).T
        order = np.argsort(from_us, kind="stable")
        latest = np.maximum.accumulate(order)  # after a reboot, times of the last boot count
        begun = np.searchsorted(from_us[order], boot_us, side="right")
        made["base"] = np.where((begun > 0) & (armed[latest[begun - 1]] != 0), _ARMED, 0)
    return made


def _system_times(log: Onboard, boot_us: IntArray) -> Payloads:
    assert log.clock is not None
    made = np.zeros(len(boot_us), dtype=_SYSTEM_TIME)
    made["unix_us"], made["boot_ms"] = log.clock.unix_us(boot_us), _ms(boot_us)
    return made


def _fixes(fixes: Fixes) -> Payloads:
    made = np.zeros(len(fixes.boot_us), dtype=_GPS_RAW_INT)
    made["boot_us"] = fixes.boot_us
    made["place"][:, 0], made["place"][:, 1] = fixes.lat_1e7, fixes.lon_1e7
    made["place"][:, 2] = _whole(fixes.alt_m * 1e3, "<i4")
    made["dop"] = 65535
    made["speed"] = _whole(fixes.speed_mps * 1e2, "<u2", unknown=65535)
    made["course"] = _whole((fixes.course_deg % 360.0) * 1e2, "<u2", unknown=65535)
    made["fix"] = np.clip(fixes.fix_type, 0, 255)
    made["satellites"] = np.clip(fixes.satellites, 0, 255)
    made["accuracies"] = _whole(fixes.accuracies * 1e3, "<u4")
    return made


def _attitudes(attitudes: Attitudes) -> Payloads:
    made = np.zeros(len(attitudes.boot_us), dtype=_ATTITUDE)
    made["boot_ms"] = _ms(attitudes.boot_us)
    made["angles"] = (attitudes.euler_rad + np.pi) % (2 * np.pi) - np.pi
    made["rates"] = attitudes.rates_radps
    return made


def _positions(positions: OnboardPositions) -> Payloads:
    made = np.zeros(len(positions.boot_us), dtype=_POSITION)
    made["boot_ms"] = _ms(positions.boot_us)
    made["place"][:, 0], made["place"][:, 1] = positions.lat_1e7, positions.lon_1e7
    made["place"][:, 2] = _whole(positions.alt_m * 1e3, "<i4")
    made["place"][:, 3] = _whole(positions.height_m * 1e3, "<i4")
    made["velocity"] = _whole(positions.velocity_ned_mps * 1e2, "<i2")
    made["heading"] = _whole((positions.heading_deg % 360.0) * 1e2, "<u2", unknown=65535)
    return made


def _truths(truth: Truth) -> Payloads:
    made = np.zeros(len(truth.boot_us), dtype=_SIM_STATE)
    made["quaternion"] = truth.ned_from_body
    made["angles"] = euler_of(truth.ned_from_body)
    made["place"][:, 0], made["place"][:, 1] = truth.lat_1e7 * 1e-7, truth.lon_1e7 * 1e-7
    made["place"][:, 2] = truth.alt_m
    made["velocity"] = truth.velocity_ned_mps
    made["place_1e7"][:, 0], made["place_1e7"][:, 1] = truth.lat_1e7, truth.lon_1e7
    return made


def _ms(boot_us: IntArray) -> Any:
    return (boot_us // 1000) & 0xFFFF_FFFF


def _whole(values: FloatArray, kind: str, unknown: int = 0) -> Any:
    """Round values to an integer type, clipped to its range; NaN becomes ``unknown``."""
    limits = np.iinfo(kind)
    bound = np.clip(np.nan_to_num(values, nan=0.0), limits.min, limits.max)
    return np.where(np.isnan(values), unknown, np.round(bound)).astype(kind)
