"""A carrier that turns to make its beams miss, within everything that their bounds assume.

It turns at up to 120 degrees a second, with the greatest angular acceleration; its attitudes are
off by their whole bound, late, and sometimes lost for more than a second; its array stands off the
point that it reports, and the UAV is near. ``worst`` says how near to their bounds its place, its
attitude and its beams came.
"""

import math
from collections.abc import Iterator
from typing import Final

import adversary
import numpy as np
import pymap3d
from adversary import KNOTS, SECONDS, START_NS, Flight, S
from pymavlink.dialects.v20 import all as dialect
from scipy.spatial.transform import Rotation

from companion.pipeline.fold import Pipeline
from companion.settings.model import Settings
from companion.values import Event, FloatArray, Tick

CARRIER: Final = "5:1"
ATTITUDE_DEG: Final = 3.0
TURN_DEGPS2: Final = 270.0
FASTEST_DEGPS: Final = 120.0
LEVER_M: Final = (1.5, -0.7, 0.4)
STEP_S: Final = 0.005
GENES: Final = 2 * adversary.GENES + 6 * KNOTS + 6
LEADS_S: Final = (0.0, 0.3)


def settings() -> Settings:
    """The assumptions that the adversary keeps to."""
    return adversary.settings().override(
        center={
            "source": CARRIER,
            "attitude_bound_deg": ATTITUDE_DEG,
            "turn_acceleration_max_degps2": TURN_DEGPS2,
        },
        array={"kind": "ura", "rows": 4, "columns": 4, "lever_arm_m": LEVER_M},
        beams={"actuation_delay_s": 0.0},
    )


class Turning:
    """A carrier and a UAV by their genes, (``GENES``,) numbers from 0 to 1."""

    def __init__(self, genes: FloatArray, seed: int = 0) -> None:
        each = adversary.GENES
        self.uav = Flight(genes[:each], seed)
        self.carrier = Flight(genes[each : 2 * each], seed + 1, CARRIER)
        self._rows = genes[2 * each : 2 * each + 6 * KNOTS].reshape(6, KNOTS)
        self._g = genes[2 * each + 6 * KNOTS :]
        self._rng = np.random.default_rng(seed + 2)
        self._turn()

    def _turn(self) -> None:
        count = round((SECONDS + 3) / STEP_S)
        most, fastest = math.radians(0.999 * TURN_DEGPS2), math.radians(FASTEST_DEGPS)
        rate, pose = np.zeros(3), Rotation.from_euler("z", 2 * math.pi * float(self._g[0]))
        rates, poses = [], []
        for at in range(count):
            rates.append(rate)
            poses.append(pose)
            t_s = at * STEP_S
            # It turns back and forth several times between two knots.
            knot = int(t_s / SECONDS * KNOTS * (1 + 20 * self._g[1])) % KNOTS
            wanted = 2 * self._rows[:3, knot] - 1
            wanted = wanted * [0.3, 0.3, 1.0]
            push = wanted * most / max(float(np.linalg.norm(wanted)), 1e-9)
            if np.linalg.norm(rate + push * STEP_S) > fastest:
                push = -rate / max(float(np.linalg.norm(rate)), 1e-9) * 0.2 * most
            pose = pose * Rotation.from_rotvec((rate + push * STEP_S / 2) * STEP_S)
            rate = rate + push * STEP_S
        self._rates = np.array(rates)
        self._poses = Rotation.concatenate(poses)

    def local_from_body(self, t_s: float) -> Rotation:
        """The true attitude at a node time."""
        at = min(int(t_s / STEP_S), len(self._rates) - 2)
        rest_s = t_s - at * STEP_S
        push = (self._rates[at + 1] - self._rates[at]) / STEP_S
        turned = self._rates[at] * rest_s + push * rest_s**2 / 2
        return self._poses[at] * Rotation.from_rotvec(turned)

    def events(self) -> list[Event]:
        """Everything that the pipeline hears, in order of arrival."""
        ticks = np.arange(0.35, SECONDS, 0.1)
        heard = self.uav.heard() + self.carrier.heard() + list(self._attitudes())
        heard += [(float(t), Tick(START_NS + round(t * S))) for t in ticks]
        heard.sort(key=lambda one: one[0])
        return [event for _, event in heard]

    def _attitudes(self) -> Iterator[tuple[float, Event]]:
        t_s, count = 0.4, 0
        while t_s < SECONDS:
            knot = min(int(t_s / SECONDS * KNOTS), KNOTS - 1)
            axis = 2 * self._rows[3:6, knot] - 1
            off = axis / max(float(np.linalg.norm(axis)), 1e-9) * math.radians(ATTITUDE_DEG - 0.01)
            swap = -1.0 if self._g[2] > 0.5 and count % 2 else 1.0
            said = self.local_from_body(t_s) * Rotation.from_rotvec(swap * off)
            yaw, pitch, roll = said.as_euler("ZYX").tolist()
            at = min(int(t_s / STEP_S), len(self._rates) - 1)
            message = dialect.MAVLink_attitude_message(
                self.carrier.boot_ms(t_s), roll, pitch, yaw, *self._rates[at].tolist()
            )
            arrival_s = t_s + self.carrier.latency_s(t_s)
            yield arrival_s, self.carrier.frame(arrival_s, message, count)
            count += 1
            lost = self._rng.random() < 0.1 * self._g[3]
            t_s += 1.5 if lost else 0.04 + 0.4 * float(self._g[4]) ** 2


def worst(flight: Turning) -> tuple[float, str, int]:
    """The greatest error as a multiple of its bound, of what, and how many beams were asked for."""
    pipeline = Pipeline(settings())
    ratio, what, queries = 0.0, "", 0
    for event in flight.events():
        if not isinstance(event, Tick):
            pipeline.step(event)
            continue
        for lead_s in LEADS_S:
            valid_ns = event.t_ns + round(lead_s * S)
            then_s = (valid_ns - START_NS) / S
            place = flight.carrier.place(then_s)
            pose = flight.local_from_body(then_s)
            found = pipeline.look(event.t_ns, lead_s)
            if found.carrier is None:
                continue
            at = found.carrier
            origin = _origin(pipeline)
            turned = Rotation.from_matrix(at.body_from_local) * pose
            ratios = {
                "place": float(np.linalg.norm(at.position_ned_m + origin - place)) / at.bound_m,
                "attitude": turned.magnitude() / at.attitude_bound_rad,
            }
            for beam in found.beams.beams:
                eye = place + pose.apply(LEVER_M)
                seen = pose.inv().apply(flight.uav.place(then_s) - eye)
                cos_e = math.cos(beam.elevation_rad)
                pointed = np.array(
                    [
                        cos_e * math.cos(beam.azimuth_rad),
                        cos_e * math.sin(beam.azimuth_rad),
                        -math.sin(beam.elevation_rad),
                    ]
                )
                off = math.acos(max(-1.0, min(1.0, float(seen @ pointed / np.linalg.norm(seen)))))
                if beam.pointing_bound_rad is not None:
                    queries += 1
                    ratios["beam"] = off / beam.pointing_bound_rad
            for name, one in ratios.items():
                if one > ratio:
                    ratio, what = one, f"{name} at {then_s:.2f} s, lead {lead_s}"
    return ratio, what, queries


def _origin(pipeline: Pipeline) -> FloatArray:
    """Where the local frame begins, (3,), in the frame of the flights."""
    lat_deg, lon_deg, alt_m = pipeline.geodetic(np.zeros((1, 3)))
    return np.array(pymap3d.geodetic2ned(lat_deg[0], lon_deg[0], alt_m[0], *adversary.PLACE))
