"""Small synthetic recordings and frames, and the location of the large logs if present."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tracks
from observed import DIRECTION, POWER
from pymavlink.dialects.v20 import all as dialect

from companion.recording.writer import Writer
from companion.values import (
    AltitudeDatum,
    Beam,
    BeamSet,
    Cause,
    Estimate,
    Event,
    Fix,
    FloatArray,
    Frame,
    LeftOut,
    Method,
    Normalisation,
    Notice,
    Reason,
    Rejection,
    Report,
    ReportNoise,
    RoundTrip,
    Severity,
    Source,
    Tick,
    Track,
    Update,
)

START_NS = 1_700_000_000_000_000_000
SHARED = Path(__file__).parents[3] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_logs() -> list[Path]:
    """All logs from other programs; the test is skipped if they are missing."""
    logs = sorted(SHARED.glob("*.tlog"))
    if not logs:
        pytest.skip(f"the shared recordings are missing ({SHARED})")
    return logs


@pytest.fixture(scope="session")
def wire() -> Callable[..., list[bytes]]:
    """``wire(n)``: n frames of three messages and two senders as they go over the wire."""

    def make(count: int, *, v1: bool = False) -> list[bytes]:
        made = []
        for number in range(count):
            mav = dialect.MAVLink(None, srcSystem=1 + number % 2, srcComponent=1)
            mav.seq = number % 256
            boot_ms = 1000 + 10 * number
            message = (
                mav.heartbeat_encode(2, 3, 0, 0, 4),
                mav.global_position_int_encode(boot_ms, 473977419, 85455938, 0, 0, 1, 2, 3, 9000),
                mav.attitude_encode(boot_ms, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6),
            )[number % 3]
            made.append(bytes(message.pack(mav, force_mavlink1=v1)))
        return made

    return make


@pytest.fixture(scope="session")
def geodetic() -> Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]]:
    """Stub for the geodesy; it only has to distinguish the axes."""
    return lambda ned_m: (47 + ned_m[:, 0] / 1e5, 8 + ned_m[:, 1] / 1e5, -ned_m[:, 2])


@pytest.fixture(scope="session")
def events(wire: Callable[..., list[bytes]]) -> Callable[[int], list[Event]]:
    """``events(n)``: frames, ticks, rejections, observations, round trips; times may step back."""

    def make(count: int) -> list[Event]:
        made: list[Event] = []
        for number, raw in enumerate(wire(count)):
            t_ns = START_NS + 10_000_000 * number - (5_000_000 if number % 5 == 0 else 0)
            link = f"udpin:127.0.0.1:{14550 + number % 2}"
            msgid = raw[7] | raw[8] << 8 | raw[9] << 16
            made.append(
                Frame(t_ns=t_ns, link=link, source=Source(raw[5], raw[6]), msgid=msgid, raw=raw)
            )
            if number % 10 == 0:
                made.append(Tick(t_ns))
            if number % 17 == 0:
                made.append(
                    Rejection(t_ns=t_ns, source=link, reason=Reason.GARBAGE, count=3 + number)
                )
            if number % 19 == 0:
                measured = DIRECTION if number % 2 else POWER
                made.append(replace(measured, t_ns=t_ns, measured_ns=t_ns - 30_000_000))
            if number % 23 == 0:
                remote_ns = (-1) ** number * 1_000_000 * number
                made.append(
                    RoundTrip(
                        t_ns=t_ns,
                        source=Source(1, 1),
                        sent_ns=t_ns - 40_000_000,
                        remote_ns=remote_ns,
                    )
                )
        return made

    return make


def _track(uav: str, t_ns: int) -> Track:
    return tracks.track(
        np.array([10.0, 20.0, -30.0]),
        uav=uav,
        valid_at_ns=t_ns + 5,
        age_s=0.25,
        unknown_input_mps=np.array([0.1, 0.2, 0.3]),
        bound_m=3.0,
        horizontal_bound_m=2.0,
        vertical_bound_m=2.5,
        dt_s=0.1,
        gamma=0.4,
        innovation_m=0.0,
        reports=7,
    )


@pytest.fixture(scope="session")
def update() -> Callable[[int], Update]:
    """``update(t_ns)``: two tracks with one beam each, and one UAV left out."""
    weights = np.array((np.arange(8).reshape(4, 2) + 0.5) * (1 - 2j), dtype=np.complex128)

    def make(t_ns: int) -> Update:
        beams = (
            Beam(
                uav="1:1",
                azimuth_rad=0.1,
                elevation_rad=-0.2,
                range_m=100.0,
                azimuth_rate_radps=None,
                elevation_rate_radps=None,
                range_rate_mps=None,
                pointing_bound_rad=None,
                gain_db=18.0,
                loss_db=0.1,
            ),
            Beam(
                uav="icao:4CA7B3",
                azimuth_rad=0.3,
                elevation_rad=0.0,
                range_m=50.0,
                azimuth_rate_radps=0.01,
                elevation_rate_radps=-0.02,
                range_rate_mps=3.0,
                pointing_bound_rad=0.02,
                gain_db=17.5,
                loss_db=0.6,
                group=1,
                widened=True,
            ),
        )
        left_out = (LeftOut("9:1", Cause.COVERAGE, "behind the array"),)
        chosen = BeamSet(
            t_ns=t_ns,
            valid_at_ns=t_ns + 5,
            beams=beams,
            weights=weights,
            method=Method.ZERO_FORCING,
            normalisation=Normalisation.STREAM,
            condition_number=1.5,
            left_out=left_out,
        )
        return Update(
            t_ns=t_ns,
            carrier=None,
            unfit=None,
            tracks=(_track("1:1", t_ns), _track("icao:4CA7B3", t_ns)),
            beams=chosen,
        )

    return make


@pytest.fixture(scope="session")
def estimate() -> Estimate:
    """An accepted report that was measured a tenth of a second before its arrival."""
    report = Report(
        t_ns=START_NS,
        uav="1:1",
        source=Source(1, 1),
        lat_deg=47.5,
        lon_deg=8.5,
        alt_m=321.5,
        alt_datum=AltitudeDatum.MSL,
        relative_alt_m=None,
        velocity_ne_mps=None,
        velocity_down_mps=None,
        heading_deg=None,
        boot_ms=1000,
        tslc_s=None,
    )
    noise = ReportNoise(horizontal_m=3.0, vertical_m=3.0, position_m=4.25, velocity_mps=0.5)
    fix = Fix(
        uav="1:1",
        sender_ns=100_000_000,
        t_ns=START_NS - 100_000_000,
        arrival_ns=START_NS,
        position_ned_m=(0.0, 0.0, 0.0),
        velocity_ned_mps=None,
        noise=noise,
        report=report,
    )
    return Estimate(
        fix=fix, position_ned_m=(0.0, 0.0, 0.0), bound_m=1.0, innovation_m=None, dt_s=None
    )


@pytest.fixture
def record(
    events: Callable[[int], list[Event]],
    geodetic: Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]],
    update: Callable[[int], Update],
    estimate: Estimate,
) -> Callable[..., list[Event]]:
    """``record(writer, n)``: write n frames and their outputs; return the events.

    ``flush_every``: frames between flushes; ``flushed`` receives (bytes, events) at each flush.
    """

    def run(
        writer: Writer,
        count: int,
        flush_every: int | None = None,
        flushed: list[tuple[int, int]] | None = None,
    ) -> list[Event]:
        driven = events(count)
        for number, event in enumerate(driven, start=1):
            writer.event(event)
            if number % 3 == 0:
                writer.output(estimate, geodetic)
                writer.output(
                    Rejection(t_ns=event.t_ns, source="1:1", reason=Reason.DUPLICATE), geodetic
                )
            if isinstance(event, Tick):
                writer.output(update(event.t_ns), geodetic)
                notice = Notice(
                    t_ns=event.t_ns, severity=Severity.WARNING, subject="1:1", text="1:1 is stale"
                )
                writer.output(notice, geodetic)
            if isinstance(event, Rejection):
                writer.output(event, geodetic)  # as the pipeline passes it on
            if flush_every and number % flush_every == 0:
                writer.flush()
                if flushed is not None:
                    flushed.append((writer.size_bytes, number))
        return driven

    return run
