"""Flight of UAVs around a carrier whose array measures their directions, from frames to beams."""

import math
from collections.abc import Iterator

import numpy as np

from companion.beams.aim import directions
from companion.beams.array import steering
from companion.pipeline.fold import Pipeline
from companion.settings.model import Settings
from companion.tracking.rotations import rotation
from companion.values import (
    Event,
    FloatArray,
    Notice,
    Observation,
    Output,
    RoundTrip,
    Source,
    Tick,
    Update,
    angle_rad,
)
from tests.sent_frames import START_NS, attitude, position

STEP_NS = 100_000_000
BOUND_RAD = math.radians(0.5)


class ObservedFlight:
    """A carrier at the origin and UAVs around it, all hovering, with a receiver.

    mount_rad  error of the array's mount, a rotation vector in the body frame
    false_m    displacement of the reported position of 1:1, north
    """

    def __init__(
        self,
        *,
        uavs: int = 4,
        range_m: float = 300.0,
        mount_rad: FloatArray | None = None,
        false_m: float = 0.0,
        **observations: object,
    ) -> None:
        self.pipeline = Pipeline(
            Settings().override(center={"source": "9:1"}, observations=dict(observations))
        )
        self.mount = rotation(np.zeros(3) if mount_rad is None else mount_rad)
        self.range_m = range_m
        self.false_m = false_m
        self.uavs = [f"{i}:1" for i in range(1, uavs + 1)]
        self.t_ns = START_NS
        self.said: list[Output] = []
        self.rng = np.random.default_rng(0)
        self.measures = True

    def offset_ned_m(self, uav: str) -> FloatArray:
        """Return the true position of a UAV relative to the array."""
        number = int(uav.partition(":")[0])
        angle = 2 * math.pi * number / 5
        return self.range_m * np.array([math.cos(angle), math.sin(angle), -0.3])

    def true_direction(self, uav: str) -> FloatArray:
        """Return the true direction of a UAV in the frame of the array as it is mounted."""
        offset = self.offset_ned_m(uav)
        return np.asarray(self.mount @ offset / np.linalg.norm(offset))

    def observation(self, uav: str) -> Observation:
        """Return a measurement of now that is off by less than its bound."""
        aside = np.cross(self.true_direction(uav), self.rng.standard_normal(3))
        aside *= 0.9 * BOUND_RAD * self.rng.random() / np.linalg.norm(aside)
        seen = self.true_direction(uav) + aside
        (azimuth,), (elevation,) = steering.angles_rad((seen / np.linalg.norm(seen))[np.newaxis])
        return Observation(
            t_ns=self.t_ns,
            measured_ns=self.t_ns,
            uav=uav,
            azimuth_rad=float(azimuth),
            elevation_rad=float(elevation),
            bound_rad=BOUND_RAD,
        )

    def events(self, seconds: float) -> Iterator[Event]:
        """Yield the events of a time."""
        for _ in range(round(seconds * 10)):
            self.t_ns += STEP_NS
            at_s = (self.t_ns - START_NS) * 1e-9
            for uav in ("9:1", *self.uavs):
                yield RoundTrip(
                    t_ns=self.t_ns,
                    source=Source.parse(uav),
                    sent_ns=self.t_ns - 2_000_000,
                    remote_ns=self.t_ns - START_NS + 100_000_000_000 - 1_000_000,
                )
                lie_m = self.false_m if uav == "1:1" else 0.0
                offset = np.zeros(3) if uav == "9:1" else self.offset_ned_m(uav)
                north, east, down = offset.tolist()
                yield position(at_s, uav, (north + lie_m, east, down))
            if self.measures:
                for uav in self.uavs:
                    yield self.observation(uav)
            yield attitude(at_s, "9:1")
            yield Tick(self.t_ns)

    def fly(self, seconds: float) -> None:
        for event in self.events(seconds):
            self.said += self.pipeline.step(event)

    def errors_deg(self) -> dict[str, float]:
        """Return by how much each beam misses its UAV now, and check its bound."""
        update = self.pipeline.look(self.t_ns)
        found = {}
        for beam, towards in zip(update.beams.beams, directions(update.beams), strict=True):
            off = angle_rad(towards, self.true_direction(beam.uav))
            assert beam.pointing_bound_rad is None or off <= beam.pointing_bound_rad
            found[beam.uav] = math.degrees(off)
        return found

    def notices(self) -> list[Notice]:
        return [one for one in self.said if isinstance(one, Notice)]

    def unbounded(self) -> int:
        """Return how many beams of all updates had no bound, including those of a look now."""
        updates = [one for one in self.said if isinstance(one, Update)]
        updates.append(self.pipeline.look(self.t_ns))
        return sum(b.pointing_bound_rad is None for one in updates for b in one.beams.beams)
