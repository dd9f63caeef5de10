"""Whatever errors reports and measurements have within their bounds, no bound is exceeded."""

import math
from collections import Counter
from functools import partial

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from companion.pipeline.array_compass import ArrayCompass
from companion.pipeline.sighted_uavs import Measured, SightedUavs
from companion.tracking.rotations import rotation_angle_rad
from companion.values import Carrier, Notice, Refuted
from tests import sighted_world
from tests.sighted_world import World

SEEDS = st.integers(0, 2**32 - 1)


class Run:
    """A world and the product's two parts, stepped together; counts what was checked."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.uavs = SightedUavs(world.settings, np.eye(3))
        self.compass = ArrayCompass(world.settings, self.uavs, world.error_max_rad)
        self.count: Counter[str] = Counter()
        self.said: list[Notice | Refuted] = []
        self.wrong_share = 0.0
        self.radii: list[float] = []
        self.bounds: list[float] = []

    def run(self, steps: int) -> None:
        world, rng = self.world, self.world.rng
        share = float(rng.choice([0.005, 0.02, 0.1]))  # of the steps, per UAV
        late_ns = int(rng.integers(0, 60)) * 1_000_000
        waiting: list[tuple[int, str, Measured]] = []
        for step in range(steps):
            world.step()
            now = world.t_ns
            for body in (*world.uavs.values(), world.carrier):
                if body.reported is None or rng.random() < 0.05:
                    body.report(now)
            if step % 20 == 0:
                world.report_attitude()
                self.settle()
            for name in world.uavs:
                if rng.random() < share:
                    seen = world.measure(name)
                    if rng.random() < self.wrong_share:
                        seen = sighted_world.tilted(rng, seen, float(rng.uniform(0, 1)))
                    one = Measured(
                        t_ns=now, direction=seen, bound_rad=world.bound_rad, time_bound_s=0.0
                    )
                    waiting.append((now + late_ns, name, one))
            ready = [one for one in waiting if one[0] <= now]
            waiting = [one for one in waiting if one[0] > now]
            for _, name, one in ready:
                self.uavs.add(name, one)
                self.settle()
            if step % 20 == 7:
                self.said += self.compass.update(now, self.carrier(), world.error_max_rad)
                self.check_error()
            if step % 4 == 0:
                self.look()

    def carrier(self) -> Carrier:
        pose = self.world.pose(self.world.t_ns, nearest=False)
        assert pose is not None
        return Carrier(
            valid_at_ns=self.world.t_ns,
            position_ned_m=np.zeros(3),
            velocity_ned_mps=None,
            body_from_local=pose.body_from_local,
            body_rates_radps=np.zeros(3),
            bound_m=0.0,
            attitude_bound_rad=self.world.error_max_rad + pose.extrapolation_rad,
            age_s=0.0,
            extrapolation_rad=pose.extrapolation_rad,
        )

    def settle(self) -> None:
        for uav, one in self.uavs.ready(self.world.attitudes[-1][0]):
            pose, near = self.world.pose(one.t_ns, nearest=True), self.world.relative(uav, one.t_ns)
            assert pose is not None and near is not None
            agrees = self.uavs.join(uav, one, pose=pose, near=near, bounds=self.compass.bounds)
            self.count["outliers"] += not agrees

    def check_error(self) -> None:
        error = self.compass.error_at(self.carrier())
        self.bounds.append(error.bound_rad)
        made_ns, _, _ = self.world.attitudes[-1]
        aged = math.radians(self.world.settings.drift_max_degps)
        aged *= (self.world.t_ns - made_ns) * 1e-9
        off = rotation_angle_rad(error.center.T @ self.world.error) - aged
        self.count["errors"] += 1
        self.count["errors beyond"] += off > error.bound_rad + 1e-9

    def look(self) -> None:
        world, now = self.world, self.world.t_ns
        pose = world.pose(now, nearest=False)
        assert pose is not None
        looks = self.compass.looks(world.uavs, self.carrier())
        near = {name: at for name in looks.each if (at := world.relative(name, now)) is not None}
        found = self.uavs.directions(
            looks, near, pose=pose, pose_at=partial(world.pose, nearest=False)
        )
        for name in near:
            seen = found.get(name)
            if seen is None:
                self.count["none"] += 1
                continue
            cap = seen.cap
            if cap is None:
                self.count["contradictions"] += 1
                continue
            self.count["looks"] += 1
            self.radii.append(cap.radius_rad)
            self.count["beyond"] += not sighted_world.is_within(cap, world.true_direction(name))


@settings(max_examples=30, deadline=None)
@given(SEEDS)
@example(7365)  # errors of compass and mount that cancel until the carrier turns
def test_no_direction_and_no_attitude_is_beyond_its_bound(seed: int) -> None:
    run = Run(sighted_world.make(seed))
    run.run(400)
    assert run.count["errors"] > 0
    assert run.count["beyond"] == 0
    assert run.count["errors beyond"] == 0
    assert run.count["outliers"] == 0 and run.count["contradictions"] == 0
    assert not run.said
