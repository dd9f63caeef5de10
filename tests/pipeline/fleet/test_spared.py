"""UAVs served by another node: protected by nulls, and without notices."""

import numpy as np
from fleet_sky import FleetSky

from companion.beams.aim import aim, directions
from companion.beams.array import steering
from companion.mavlink.wire.framing import Splitter
from companion.pipeline.fold import Pipeline
from companion.settings.model import Settings
from companion.values import Duty, Frame, Notice, Tick

S = 1_000_000_000
START_NS = 1_800_000_000 * S


def flown(pipeline: Pipeline, seconds: float, begins_ns: int = START_NS) -> list[str]:
    """Return the notices of a flight of two vehicles."""
    sky, said = FleetSky(ports=[], uavs=2), []
    for step in range(round(10 * seconds)):
        now_ns = begins_ns + step * S // 10
        for number in range(2):
            frame = Splitter("udp").feed(now_ns, sky.report(number, sky.begun_s + step / 10))[0]
            assert isinstance(frame, Frame)
            pipeline.step(frame)
        said += pipeline.step(Tick(now_ns + 1))
    return [one.text for one in said if isinstance(one, Notice)]


def test_uav_returning_from_another_node_is_not_announced_again() -> None:
    pipeline = Pipeline(Settings().override(center={"source": "47.3977,8.5456,480"}))
    pipeline.step(Duty(START_NS, ("1:1", "2:1")))
    said = flown(pipeline, 1.0)
    for serves in (("1:1",), ("1:1", "2:1")):
        pipeline.step(Duty(START_NS + S, serves))
        said += flown(pipeline, 1.0, START_NS + 2 * S)
    assert said.count("2:1 is live") == 1


def test_beams_have_nulls_on_protected_uavs() -> None:
    pipeline = Pipeline(
        Settings().override(center={"source": "47.3977,8.5456,480"}, beams={"widen": "no"})
    )
    pipeline.step(Duty(START_NS, ("1:1",), ("2:1",)))
    flown(pipeline, 3.0)
    now_ns = START_NS + 3 * S
    towards_db = {}
    for spares in (("2:1",), ()):
        pipeline.step(Duty(now_ns, ("1:1",), spares))
        update = pipeline.look(now_ns)
        assert update.beams.uavs == ("1:1",)
        assert "2:1" not in {one.uav for one in update.beams.left_out}
        track = pipeline.tracks(now_ns, update.beams.valid_at_ns, ["2:1"])
        seen = aim(
            now_ns,
            valid_at_ns=update.beams.valid_at_ns,
            tracks=track,
            carrier=update.carrier,
            array=pipeline.array,
            precoder=pipeline.precoder,
        )
        there = steering.steering_matrix(pipeline.array, directions(seen))
        weights = update.beams.weights
        gain = np.abs(there.T @ weights).item() ** 2 / np.linalg.norm(weights) ** 2
        towards_db[spares] = 10 * np.log10(gain + 1e-30)
    assert towards_db[("2:1",)] < -100 < -60 < towards_db[()]
