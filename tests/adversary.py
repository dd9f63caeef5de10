"""A flight made to break the bound, within everything that the bound assumes.

The adversary chooses what nothing excludes: accelerations of the greatest size, errors of reports
on the edge of their bounds, the lag of positions within its interval, a clock that drifts to and
fro, how long every frame takes, and how long the two ways of every TIMESYNC answer take.
``Flight`` makes a flight of numbers from 0 to 1, so that a search (``adversary_search``) can turn
them; ``worst`` says how near to its bound any answer came, and what good report was refused.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pymap3d
from pymavlink.dialects.v20 import all as dialect

from companion.pipeline.fold import Pipeline
from companion.settings.model import Settings
from companion.values import (
    Event,
    FloatArray,
    Frame,
    Notice,
    Reason,
    Refuted,
    Rejection,
    RoundTrip,
    Source,
    Tick,
)

S: Final = 1_000_000_000
START_NS: Final = 1_760_000_000 * S
BOOT_S: Final = 100.0
PLACE: Final = (47.4, 8.55, 500.0)
UAV: Final = "7:1"

ACCELERATION_MPS2: Final = 6.0
SPEED_MPS: Final = 60.0
LAG_S: Final = (0.0, 0.06)
DRIFT: Final = 250e-6
POSITION_NOISE_M: Final = 2.0
VELOCITY_NOISE_MPS: Final = 0.5
COARSE: Final = 0.03  # what the message's steps, and the earth's curvature over the flight, take
UNSEEN_S: Final = 0.02  # within what is taken for possible of a link that is only heard

KNOTS: Final = 12
STEP_S: Final = 0.02
SECONDS: Final = 40.0
LEADS_S: Final = (0.0, 0.1, 0.3, 1.0)
GENES: Final = 8 * KNOTS + 24


def settings() -> Settings:
    """The assumptions that the adversary keeps to."""
    return Settings().override(
        center={"source": f"{PLACE[0]},{PLACE[1]},{PLACE[2]}"},
        observer={
            "acceleration_max_mps2": ACCELERATION_MPS2,
            "speed_max_mps": SPEED_MPS,
            "lag_s": LAG_S,
            "position_noise_m": POSITION_NOISE_M,
            "velocity_noise_mps": VELOCITY_NOISE_MPS,
        },
        clocks={"drift_max_ppm": DRIFT * 1e6},
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Worst:
    """What a flight came to.

    ratio     the greatest error, as a multiple of its bound
    outside   the same for the least ball that holds all that is possible
    at        when the first was, and its parts: in space, in the plane, in height
    queries   how often it was asked
    refused   good reports that were refused
    refuted   assumptions that were said to be refuted, though they were kept to
    """

    ratio: float
    outside: float
    at: str
    queries: int
    refused: tuple[str, ...]
    refuted: tuple[str, ...]


class Flight:
    """A flight by its genes, (``GENES``,) numbers from 0 to 1.

    Whatever they are, the assumptions of ``settings`` hold.
    """

    def __init__(self, genes: FloatArray, seed: int = 0, uav: str = UAV) -> None:
        self._source = Source.parse(uav)
        self._rng = np.random.default_rng(seed)
        rows = genes[: 8 * KNOTS].reshape(8, KNOTS)
        self._g = genes[8 * KNOTS :]
        self._knots_s = np.linspace(0.0, SECONDS, KNOTS)
        self._rows = rows
        self._fly(rows[:3])
        self._run_clock(rows[3])

    # --- the truth ----------------------------------------------------------------------------

    def _fly(self, rows: FloatArray) -> None:
        """Turn and accelerate by the greatest acceleration, without passing the greatest speed."""
        self.times_s = np.arange(0.0, SECONDS + 3.0, STEP_S)
        speed = 1.0 + (SPEED_MPS - 3.0) * self._g[0]
        velocity = speed * np.array([1.0, 0.0, 0.0])
        place = np.array([-200.0 + 400.0 * self._g[1], -500.0, -100.0])
        places, velocities = [place], [velocity]
        for now_s in self.times_s[:-1]:
            at = min(int(now_s / SECONDS * KNOTS), KNOTS - 1)
            along = velocity / max(float(np.linalg.norm(velocity)), 1e-9)
            side = np.cross(along, [0.0, 0.0, 1.0])
            side = side / max(float(np.linalg.norm(side)), 1e-9)
            wanted = 2 * rows[:, at] - 1
            wanted = wanted[0] * along + wanted[1] * side + wanted[2] * np.array([0, 0, 0.5])
            size = float(np.linalg.norm(wanted))
            push = wanted * (0.999 * ACCELERATION_MPS2 / max(size, 1e-9))
            if np.linalg.norm(velocity + push * STEP_S) > SPEED_MPS - 1.0:
                push = push - (push @ along) * along
                push = push - 0.1 * ACCELERATION_MPS2 * along
                push *= min(1.0, 0.999 * ACCELERATION_MPS2 / float(np.linalg.norm(push)))
            place = place + velocity * STEP_S + push * STEP_S**2 / 2
            velocity = velocity + push * STEP_S
            places.append(place)
            velocities.append(velocity)
        self.places, self.velocities = np.array(places), np.array(velocities)

    def _run_clock(self, row: FloatArray) -> None:
        """Sender time over node time: the drift is within its bound, and changes at the knots."""
        drift = 0.98 * DRIFT * (2 * row - 1)
        steps = drift[np.minimum((self.times_s / SECONDS * KNOTS).astype(int), KNOTS - 1)] * STEP_S
        self.drifted_s = np.concatenate([[0.0], np.cumsum(steps)[:-1]])

    def place(self, t_s: float) -> FloatArray:
        """The true place (3,) at a node time."""
        at = min(int(t_s / STEP_S), len(self.times_s) - 2)
        rest = t_s - self.times_s[at]
        push = (self.velocities[at + 1] - self.velocities[at]) / STEP_S
        found: FloatArray = self.places[at] + self.velocities[at] * rest + push * rest * rest / 2
        return found

    def boot_ms(self, t_s: float) -> int:
        """The sender's clock at a node time, in the whole milliseconds that it stamps."""
        return int(1000 * (BOOT_S + t_s + float(np.interp(t_s, self.times_s, self.drifted_s))))

    # --- what is heard ------------------------------------------------------------------------

    def latency_s(self, t_s: float) -> float:
        """How long a frame takes that is sent now: ramps, steps, sawteeth, bursts, quick ones."""
        g = self._g
        level = float(np.interp(t_s, self._knots_s, self._rows[4]))
        if g[2] < 0.5:  # steps instead of ramps
            level = float(self._rows[4][min(int(t_s / SECONDS * KNOTS), KNOTS - 1)])
        most_s = 0.02 if g[3] < 0.15 else 1.5 * g[3]
        if g[4] > 0.7:
            period_s = 0.5 + 10 * g[5]
            level = (t_s % period_s) / period_s
        latency_s = most_s * level + self._rng.exponential(0.2) * (g[6] > 0.6) * g[7]
        if self._rng.random() < 0.3 * g[8]:
            latency_s *= 0.1
        return latency_s

    def events(self) -> list[Event]:
        """Everything that the pipeline hears, ticks among it, in order of arrival."""
        ticks = np.arange(0.35, SECONDS, 0.1)
        heard = self.heard() + [(float(t), Tick(START_NS + round(t * S))) for t in ticks]
        heard.sort(key=lambda one: one[0])
        return [event for _, event in heard]

    def heard(self) -> list[tuple[float, Event]]:
        """Reports and answers, with their times of arrival, in any order."""
        g, rng = self._g, self._rng
        period_s = 0.05 + 1.5 * g[9] ** 2
        heard: list[tuple[float, Event]] = []
        t_s, count = 0.3, 0
        while t_s < SECONDS:
            first = count == 0 or t_s < 0.6 + 2 * g[10] * (g[11] > 0.5)
            latency_s = UNSEEN_S * g[12] if first else self.latency_s(t_s)
            heard.append((t_s + latency_s, self._report(t_s, latency_s, count)))
            count += 1
            t_s += period_s * (1.0 if g[13] < 0.5 else rng.uniform(0.2, 1.8))
        if g[14] > 0.5:
            heard += self._answers()
        return heard

    def _report(self, t_s: float, latency_s: float, count: int) -> Frame:
        g, knot = self._g, min(int(t_s / SECONDS * KNOTS), KNOTS - 1)
        lag_s = LAG_S[0] + (LAG_S[1] - LAG_S[0]) * float(self._rows[5][knot])
        # What is stamped now was true that long ago.
        place, velocity = self.place(max(0.0, t_s - lag_s)), self._velocity(max(0.0, t_s - lag_s))
        along = velocity / max(float(np.linalg.norm(velocity)), 1e-9)
        turn = 2 * math.pi * float(self._rows[6][knot])
        swap = -1.0 if g[15] > 0.5 and count % 2 else 1.0
        edge = math.cos(turn) * along + math.sin(turn) * np.cross(along, [0.0, 0.0, 1.0])
        edge = edge / max(float(np.linalg.norm(edge)), 1e-9)
        place = place + swap * (POSITION_NOISE_M - COARSE) * edge
        turn = 2 * math.pi * float(self._rows[7][knot])
        edge = math.cos(turn) * along + math.sin(turn) * np.cross(along, [0.0, 0.0, 1.0])
        velocity = velocity + swap * (VELOCITY_NOISE_MPS - 2 * COARSE) * edge
        lat, lon, alt = pymap3d.ned2geodetic(*place, *PLACE)
        message = dialect.MAVLink_global_position_int_message(
            self.boot_ms(t_s), round(float(lat) * 1e7), round(float(lon) * 1e7),
            round(float(alt) * 1e3), 0, *(round(100 * v) for v in velocity.tolist()), 65535,
        )  # fmt: skip
        return self.frame(t_s + latency_s, message, count)

    def frame(self, arrival_s: float, message: Any, count: int) -> Frame:
        """A message as it arrives."""
        sender = dialect.MAVLink(None, self._source.sysid, self._source.compid)
        sender.seq = count % 256
        raw, msgid = bytes(message.pack(sender)), message.get_msgId()
        return Frame(
            t_ns=START_NS + round(arrival_s * S),
            link="udp",
            source=self._source,
            msgid=msgid,
            raw=raw,
        )

    def _velocity(self, t_s: float) -> FloatArray:
        at = min(int(t_s / STEP_S), len(self.times_s) - 2)
        rest = (t_s - self.times_s[at]) / STEP_S
        found: FloatArray = (1 - rest) * self.velocities[at] + rest * self.velocities[at + 1]
        return found

    def _answers(self) -> Iterator[tuple[float, Event]]:
        g, rng = self._g, self._rng
        t_s = 1.0
        while t_s < SECONDS - 3:
            there_s, back_s = 1.5 * g[16] * rng.random(), 1.5 * g[17] * rng.random()
            if rng.random() < 0.5 * g[18]:
                there_s *= 0.02
            at_s = t_s + there_s
            drifted_s = float(np.interp(at_s, self.times_s, self.drifted_s))
            remote_ns = round((BOOT_S + at_s + drifted_s) * S)
            back_ns = START_NS + round((at_s + back_s) * S)
            trip = RoundTrip(
                t_ns=back_ns,
                source=self._source,
                sent_ns=START_NS + round(t_s * S),
                remote_ns=remote_ns,
            )
            yield at_s + back_s, trip
            t_s += 0.2 + 5 * g[19]


def worst(flight: Flight) -> Worst:
    """The worst that comes of a flight: every tick asks for every lead."""
    pipeline = Pipeline(settings())
    ratio, outside, at, queries = 0.0, 0.0, "", 0
    refused: list[str] = []
    refuted: list[str] = []
    for event in flight.events():
        if isinstance(event, Tick):
            for lead_s in LEADS_S:
                valid_ns = event.t_ns + round(lead_s * S)
                for track in pipeline.tracks(event.t_ns, valid_ns):
                    truth = flight.place((valid_ns - START_NS) / S)
                    off = track.position_ned_m - truth
                    plane = math.hypot(off[0], off[1]) / track.horizontal_bound_m
                    set_off = track.set_center_ned_m - truth
                    ratios = (
                        math.sqrt(off @ off) / track.bound_m,
                        plane,
                        abs(float(off[2])) / track.vertical_bound_m,
                    )
                    queries += 1
                    outside = max(outside, math.sqrt(set_off @ set_off) / track.set_radius_m)
                    if max(ratios) > ratio:
                        ratio = max(ratios)
                        at = f"{(event.t_ns - START_NS) / S:.2f} s, lead {lead_s}: {ratios}"
            continue
        for said in pipeline.step(event):
            late = isinstance(said, Rejection) and said.reason in (
                Reason.OUT_OF_ORDER, Reason.DUPLICATE, Reason.FROZEN,
            )  # fmt: skip
            if isinstance(said, Rejection) and not late:
                refused.append(f"{said.reason}: {said.detail}")
            if isinstance(said, Refuted) and not said.setting.startswith("clocks."):
                refuted.append(str(said))
            if isinstance(said, Notice) and "limit" in said.text:
                refuted.append(said.text)
    return Worst(
        ratio=ratio,
        outside=outside,
        at=at,
        queries=queries,
        refused=tuple(refused),
        refuted=tuple(refuted),
    )
