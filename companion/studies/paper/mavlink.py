"""Published scenario through the whole service, from MAVLink frames to predictions and beams.

Each UAV sends GLOBAL_POSITION_INT at every step with its leading position y = x + D W and, as its
velocity, W. Positions are in 1e-7 degree and millimetres, velocities in cm/s, times in ms. The
service's position observer also forms a lead from the velocity, so its feedthrough is D plus that
lead. It follows the scenario without error except for the rounding of the message. The expected
answer is computed in parallel from the numbers before rounding.
"""

import struct
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from companion.mavlink.wire.encode import Outgoing, pack
from companion.mavlink.wire.framing import Splitter
from companion.mavlink.wire.positions import GLOBAL_POSITION_INT
from companion.pipeline.fold import Pipeline
from companion.settings.model import Settings
from companion.studies.paper import published
from companion.studies.paper.circles import PaperFlight
from companion.tracking.geodesy import LocalFrame
from companion.values import Estimate, FloatArray, Frame, Source

ORIGIN: Final = (47.4, 8.5, 500.0)
START_NS: Final = 1_700_000_000_000_000_000
BOOT_MS: Final = 10_000
VELOCITY_LEAD_S: Final = 0.2
NO_HEADING: Final = 0xFFFF
_LAYOUT: Final = struct.Struct("<IiiiihhhH")
"""Fields of GLOBAL_POSITION_INT: time_boot_ms, lat, lon, alt, relative_alt, vx, vy, vz, hdg.

Source: https://mavlink.io/en/messages/common.html#GLOBAL_POSITION_INT.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """Largest differences between service and library over all UAVs and steps."""

    reports: int  # reports accepted
    rejections: int  # reports rejected
    estimate_m: float  # of predictions of the next report's position
    direction_deg: float  # of beams aimed at it
    settled_m: float  # largest true error in the last quarter


def settings(flight: PaperFlight) -> Settings:
    """Return the service's settings for the scenario.

    The array is level and faces north; limits are the largest values of this motion. Stamps are
    exact and frames arrive without delay.
    """
    scenario = flight.scenario
    fastest_mps = 1.01 * float(np.linalg.norm(flight.input_mps, axis=-1).max())
    acceleration = np.linalg.norm(np.diff(flight.input_mps, axis=0), axis=-1) / scenario.dt_s
    return Settings().override(
        center={"source": f"{ORIGIN[0]},{ORIGIN[1]},{ORIGIN[2]},0"},
        beams={"actuation_delay_s": 0.0},
        observer={
            "model": "position",
            "lag_s": (0.0, 0.0),
            "feedthrough_s": scenario.feedthrough_s,
            "velocity_lead_s": VELOCITY_LEAD_S,
            "speed_max_mps": fastest_mps,
            "acceleration_max_mps2": 1.01 * float(acceleration.max()),
            "position_noise_m": 0.5,
            "velocity_noise_mps": 0.1,
        },
    )


def frames(flight: PaperFlight) -> list[bytes]:
    """Return the concatenated frames of all UAVs at each step, 1:1 first."""
    local = LocalFrame(*ORIGIN)
    sent = []
    for step, (places, inputs) in enumerate(zip(flight.report_m, flight.input_mps, strict=True)):
        ned_m = np.concatenate([places, np.zeros((len(places), 1))], axis=1)
        lat_deg, lon_deg, alt_m = local.geodetic(ned_m)
        here = []
        for number, (north_mps, east_mps) in enumerate(inputs.tolist()):
            payload = _LAYOUT.pack(
                BOOT_MS + round(step * flight.scenario.dt_s * 1e3),
                round(float(lat_deg[number]) * 1e7),
                round(float(lon_deg[number]) * 1e7),
                round(float(alt_m[number]) * 1e3),
                round((float(alt_m[number]) - ORIGIN[2]) * 1e3),
                *(round(north_mps * 100), round(east_mps * 100), 0),
                NO_HEADING,
            )
            message = Outgoing(Source(number + 1, 1), GLOBAL_POSITION_INT, payload)
            here.append(pack(message, step % 256))
        sent.append(b"".join(here))
    return sent


def compare(flight: PaperFlight) -> Agreement:
    """Run the scenario through the service (splitter, pipeline, beams) and through the library."""
    pipeline, splitter = Pipeline(settings(flight)), Splitter("paper")
    names = [f"{number + 1}:1" for number in range(len(flight.scenario.radii_m))]
    expected = _expected(flight)
    estimate_m = direction_deg = settled_m = 0.0
    reports = 0
    for step, data in enumerate(frames(flight)):
        t_ns = START_NS + round(step * flight.scenario.dt_s * 1e9)
        seen = [event for event in splitter.feed(t_ns, data) if isinstance(event, Frame)]
        for output in (output for frame in seen for output in pipeline.step(frame)):
            if isinstance(output, Estimate):
                reports += 1
                there = expected[step, names.index(output.fix.uav)]
                estimate_m = max(estimate_m, _apart_m(output.position_ned_m, there))
        next_ns = START_NS + round((step + 1) * flight.scenario.dt_s * 1e9)
        update = pipeline.look(next_ns)
        for track in update.tracks:
            number = names.index(track.uav)
            estimate_m = max(estimate_m, _apart_m(track.position_ned_m, expected[step + 1, number]))
            if step >= 3 * len(flight.report_m) // 4:
                truth = flight.position_m[step + 1, number]
                settled_m = max(settled_m, _apart_m(track.position_ned_m, truth))
        for beam in update.beams.beams if update.beams else ():
            north, east = expected[step + 1, names.index(beam.uav)]
            off = beam.azimuth_rad - np.arctan2(east, north)
            off_deg = float(np.degrees(np.abs(np.arctan2(np.sin(off), np.cos(off)))))
            direction_deg = max(direction_deg, off_deg)
    refused = 4 * len(flight.report_m) - reports
    return Agreement(
        reports=reports,
        rejections=refused,
        estimate_m=estimate_m,
        direction_deg=direction_deg,
        settled_m=settled_m,
    )


def _expected(flight: PaperFlight) -> FloatArray:
    """Return the library's estimates (K + 1, N, 2).

    The published step uses the velocity as the service does, and starts at the first report.
    """
    scenario = flight.scenario
    lead_s = max(VELOCITY_LEAD_S, scenario.dt_s)
    estimates = [flight.report_m[0]]
    for report, inputs in zip(flight.report_m, flight.input_mps, strict=True):
        led = report + lead_s * inputs
        step = published.step(
            estimates[-1],
            report_m=led,
            dt_s=scenario.dt_s,
            feedthrough_s=scenario.feedthrough_s + lead_s,
        )
        estimates.append(step.estimate_m)
    return np.array(estimates)


def _apart_m(position_ned_m: ArrayLike, place_m: FloatArray) -> float:
    return float(np.linalg.norm(np.asarray(position_ned_m)[:2] - place_m))
