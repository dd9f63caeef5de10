"""One forged frame of each message that the pipeline reads, sent from the vehicle's own peer.

A sender that fully impersonates the vehicle is trusted in the end; a single frame must not break
a bound silently. Bounds may grow, tracks may be lost and frames may be rejected: that is
announced.
"""

import math
import random
import struct
from collections.abc import Iterator

import pytest
from load_sender import frame

from companion.pipeline.fold import Pipeline
from companion.settings.model import Settings
from companion.values import Frame, Notice, Refuted, Severity, Source, Tick, Update

S = 1_000_000_000
BEGINS_NS = 1_790_000_000 * S
LATE_NS = 30_000_000
RADIUS_M, RATE_RADPS = 150.0, 0.15
M_PER_DEG = 111_320.0
LAT, LON = 47.0, 8.0
HEARTBEAT, GPS_RAW_INT, ATTITUDE, GLOBAL_POSITION_INT, EKF = 0, 24, 30, 33, 193
CARRIER, UAV = (5, 1), (1, 1)


def place_ne_m(ids: tuple[int, int], t_s: float) -> tuple[float, float, float, float]:
    """Return north, east and their rates: the carrier hovers, the UAV circles."""
    if ids == CARRIER:
        return 0.0, 0.0, 0.0, 0.0
    angle, v = RATE_RADPS * t_s, RADIUS_M * RATE_RADPS
    north, east = RADIUS_M * math.cos(angle), RADIUS_M * math.sin(angle)
    return north, east, -v * math.sin(angle), v * math.cos(angle)


def yaw_rad(t_s: float) -> float:
    return 0.05 * t_s


def said(ids: tuple[int, int], msgid: int, t_s: float) -> bytes:
    """Return the payload of a genuine frame at a time."""
    north, east, v_north, v_east = place_ne_m(ids, t_s)
    boot_ms = 60_000 + round(t_s * 1e3)
    lat = round((LAT + north / M_PER_DEG) * 1e7)
    lon = round((LON + east / (M_PER_DEG * math.cos(math.radians(LAT)))) * 1e7)
    match msgid:
        case 0:
            return struct.pack("<IBBBBB", 4, 2, 3, 217, 4, 3)
        case 24:
            return struct.pack("<QiiiHHHHBBiIIIIB", boot_ms * 1000, lat, lon, 550_000, 60, 90, 0, 0,
                               3, 17, 550_000, 2000, 3000, 300, 0, 1)  # fmt: skip
        case 30:
            return struct.pack("<Iffffff", boot_ms, 0.0, 0.0, yaw_rad(t_s), 0.0, 0.0, 0.05)
        case 33:
            velocity = (round(v_north * 100), round(v_east * 100), 0)
            return struct.pack("<IiiiihhhH", boot_ms, lat, lon, 550_000, 50_000, *velocity, 9001)
        case _:
            return struct.pack("<fffffHf", 0.1, 0.1, 0.1, 0.1, 0.1, 831, 0.1)


def flight(seconds: float) -> Iterator[Frame | Tick]:
    """Return both vehicles' frames and ticks at 10 Hz; other messages once per second."""
    for n in range(round(seconds * 10)):
        t_s = n / 10
        at_ns = BEGINS_NS + round(t_s * S)
        for ids in (CARRIER, UAV):
            beside = (HEARTBEAT, GPS_RAW_INT, EKF) if n % 10 == 0 else ()
            for msgid in (*beside, ATTITUDE, GLOBAL_POSITION_INT):
                raw = frame(ids, n % 256, msgid, said(ids, msgid, t_s))
                yield Frame(
                    t_ns=at_ns + LATE_NS, link="udp", source=Source(*ids), msgid=msgid, raw=raw
                )
        yield Tick(at_ns + LATE_NS + 20_000_000)


def lies(pipeline: Pipeline, update: Update) -> list[str]:
    """Return the bounds that do not hold."""
    found = []
    t_s = (update.beams.valid_at_ns - BEGINS_NS) * 1e-9
    assert pipeline.local is not None
    for track in update.tracks:
        north, east, _, _ = place_ne_m(UAV, t_s)
        lat, lon, _ = pipeline.local.place(*track.position_ned_m.tolist())
        error_m = math.hypot(
            (lat - LAT) * M_PER_DEG - north,
            (lon - LON) * M_PER_DEG * math.cos(math.radians(LAT)) - east,
        )
        if track.uav == "1:1" and error_m > track.bound_m:
            found.append(f"{t_s:.2f} s: {error_m:.1f} m, bound {track.bound_m:.1f} m")
    if update.carrier is not None:
        x, y = update.carrier.body_from_local[0, :2]
        off_rad = abs(math.remainder(math.atan2(y, x) - yaw_rad(t_s), math.tau))
        bound_rad = update.carrier.attitude_bound_rad
        if off_rad > bound_rad:
            found.append(f"{t_s:.2f} s: turned by {off_rad:.2f}, bound {bound_rad:.2f}")
    return found


def flown(forged: tuple[int, Frame] | None, seconds: float = 5.0) -> list[str]:
    """Return the broken bounds of a flight with a frame inserted after so many events, until a
    notice.

    A notice is a refuted assumption or a warning. Before the frame the flight is the genuine one
    and is not checked: ticks take most of the time.
    """
    pipeline, found = Pipeline(Settings().override(center={"source": "5:1"})), list[str]()
    for number, event in enumerate(flight(seconds)):
        if forged is not None and number < forged[0] and isinstance(event, Tick):
            continue
        outputs = pipeline.step(event)
        if forged is not None and number == forged[0]:
            outputs += pipeline.step(forged[1]._replace(t_ns=event.t_ns + 1_000_000))
        for output in outputs:
            told = isinstance(output, Notice) and output.severity is Severity.WARNING
            if number > 90 and (told or isinstance(output, Refuted)):
                return found
            if isinstance(output, Update):
                found += lies(pipeline, output)
    return found


def forged(
    ids: tuple[int, int], msgid: int, at: int, offset: int, form: str, *values: float
) -> tuple[int, Frame]:
    """Return a genuine frame after so many events with some of its bytes changed."""
    payload = bytearray(said(ids, msgid, at // 5 / 10))
    struct.pack_into(form, payload, offset, *values)
    return at, Frame(
        t_ns=0,
        link="udp",
        source=Source(*ids),
        msgid=msgid,
        raw=frame(ids, 77, msgid, bytes(payload)),
    )


def test_genuine_flight_keeps_its_bounds() -> None:
    assert flown(None) == []


@pytest.mark.parametrize(
    ("at", "offset", "value"),
    [(122, 12, math.pi), (123, 12, 1.0)]
    + [
        pytest.param(at, *wrong, marks=pytest.mark.full)
        for at in (120, 123)
        for wrong in ((12, math.pi), (12, 1.0), (4, 0.5), (16, 20.0), (24, -20.0), (20, 3.0))
    ],
)
def test_forged_attitude_stays_within_the_bound(at: int, offset: int, value: float) -> None:
    assert flown(forged(CARRIER, ATTITUDE, at, offset, "<f", value), 2.8) == []


@pytest.mark.full
@pytest.mark.parametrize("seed", range(40))
def test_forged_frame_breaks_no_bound_without_a_warning(seed: int) -> None:
    rng = random.Random(seed)
    for msgid in (HEARTBEAT, GPS_RAW_INT, ATTITUDE, GLOBAL_POSITION_INT, EKF):
        ids, at = rng.choice((CARRIER, UAV)), rng.randrange(120, 200)
        size = len(said(ids, msgid, 0.0))
        offset = rng.randrange(size)
        least = min(offset + rng.randrange(1, 5), size) - offset
        wrong = rng.choice((rng.randbytes(least), b"\xff" * least, bytes(least)))
        assert flown(forged(ids, msgid, at, offset, f"{least}s", wrong)) == [], (msgid, at, offset)
