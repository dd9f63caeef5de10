"""A day of a changing sky, in virtual time: vehicles and aircraft come, restart and go."""

import gc
import math
import random
import re
import struct
from collections.abc import Iterator
from pathlib import Path

from companion.mavlink.wire.decode import ATTITUDE, HEARTBEAT
from companion.mavlink.wire.encode import Outgoing, pack
from companion.mavlink.wire.positions import GLOBAL_POSITION_INT
from companion.mavlink.wire.transponder import ADSB_VEHICLE
from companion.pipeline.fold import Pipeline
from companion.settings.model import Settings
from companion.values import Event, Frame, Source, Tick
from companion.views.last_messages import LastMessages
from companion.views.series import Series

S = 1_000_000_000
CARRIER = Source(5, 1)
HERE = (47.3977, 8.5456, 500.0)
STEP_S = 3.0
"""Between two reports of a vehicle, and two ticks."""
VEHICLES, STAYS_S = 6, 900.0
AIRCRAFT, CROSSES_S = 6, 240.0


class _Flight:
    """A circle of somebody, who was switched on and goes again."""

    def __init__(self, rng: random.Random, source: Source, begins_s: float, stays_s: float) -> None:
        self.source, self.icao = source, rng.randrange(1, 1 << 24)
        self.booted_s, self.ends_s = begins_s, begins_s + stays_s * rng.uniform(0.5, 1.5)
        self.radius_m, self.phase = rng.uniform(50, 2000), rng.uniform(0, 6)

    def report(self, now_s: float, velocity: float = 8.0) -> tuple[int, int, int, int, int, int]:
        """Boot ms; latitude and longitude, 1e-7 deg; height, mm; velocity north and east, cm/s."""
        angle = self.phase + velocity * (now_s - self.booted_s) / self.radius_m
        north, east = self.radius_m * math.cos(angle), self.radius_m * math.sin(angle)
        lat = HERE[0] + north / 111_195
        lon = HERE[1] + east / 111_195 / math.cos(math.radians(HERE[0]))
        return (
            round((now_s - self.booted_s) * 1000), round(lat * 1e7), round(lon * 1e7), 560_000,
            round(-100 * velocity * math.sin(angle)), round(100 * velocity * math.cos(angle)),
        )  # fmt: skip


def day(hours: float, seed: int = 1, begins_ns: int = 1_790_000_000 * S) -> Iterator[Event]:
    """The events of so many hours, in order."""
    rng = random.Random(seed)
    free = [n for n in range(1, 250) if n != CARRIER.sysid]
    flying = [_Flight(rng, Source(rng.choice(free), 1), 0, STAYS_S) for _ in range(VEHICLES)]
    crossing = [_Flight(rng, Source(0, 156), 0, CROSSES_S) for _ in range(AIRCRAFT)]
    carrier = _Flight(rng, CARRIER, 0, math.inf)
    carrier.radius_m = 1.0
    for number in range(round(hours * 3600 / STEP_S)):
        now_s = number * STEP_S
        t_ns = begins_ns + round(now_s * S)
        if number % 3600 == 3599:
            carrier.booted_s = now_s  # every three hours it restarts
        for group in (flying, crossing):
            for at, one in enumerate(group):
                if now_s > one.ends_s:
                    source = Source(rng.choice(free), 1) if group is flying else one.source
                    group[at] = _Flight(
                        rng, source, now_s, STAYS_S if group is flying else CROSSES_S
                    )
        yield _said(t_ns, carrier.source, HEARTBEAT, struct.pack("<IBBBBB", 0, 2, 3, 0, 4, 3))
        boot_ms = carrier.report(now_s)[0]
        yield _said(t_ns, carrier.source, ATTITUDE, struct.pack("<I6f", boot_ms, *[0.01] * 6))
        yield _position(t_ns, carrier, now_s, 0.0)
        for each in flying:
            yield _position(t_ns, each, now_s, 8.0)
        if number % 2:
            for each in crossing:
                yield _aircraft(t_ns, each, now_s)
        yield Tick(t_ns + S // 10)


def _said(t_ns: int, source: Source, msgid: int, payload: bytes) -> Frame:
    return Frame(
        t_ns=t_ns,
        link="udp",
        source=source,
        msgid=msgid,
        raw=pack(Outgoing(source, msgid, payload), 0),
    )


def _position(t_ns: int, one: _Flight, now_s: float, velocity: float) -> Frame:
    boot_ms, lat, lon, alt, north, east = one.report(now_s, velocity)
    payload = struct.pack("<IiiiihhhH", boot_ms, lat, lon, alt, 60_000, north, east, 0, 65535)
    return _said(t_ns, one.source, GLOBAL_POSITION_INT, payload)


def _aircraft(t_ns: int, one: _Flight, now_s: float) -> Frame:
    _, lat, lon, alt, _, _ = one.report(now_s, 80.0)
    fields = (one.icao, lat, lon, alt, 0, 8000, 0, 1 | 2, 0, 1, b"SOAK", 3, 0)
    return _said(t_ns, one.source, ADSB_VEHICLE, struct.pack("<IiiiHHhHHB9sBB", *fields))


def resident_mb() -> float:
    """What this process has in memory."""
    gc.collect()
    found = re.search(r"VmRSS:\s+(\d+)", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found[1]) / 1000


def flown(hours: int) -> tuple[list[float], int]:
    """Memory at the end of each hour, MB, of all that a service keeps of its links.

    And how many senders' clocks are kept at the end.
    """
    settings = Settings().override(center={"source": "5:1"})
    pipeline, series, messages = Pipeline(settings), Series(), LastMessages()
    begins_ns, found = 1_790_000_000 * S, list[float]()
    for event in day(hours, begins_ns=begins_ns):
        if isinstance(event, Frame):
            messages.add(event)
        pipeline.step(event)
        if isinstance(event, Tick):
            series.add(pipeline)
            if (event.t_ns - begins_ns) // (3600 * S) > len(found):
                found.append(resident_mb())
    found.append(resident_mb())
    return found, len(pipeline.senders._senders)
