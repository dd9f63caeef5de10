"""Aircraft and their receivers: ADS-B rules of MAVLink, decoded by pymavlink."""

import math
from collections import defaultdict
from itertools import islice, pairwise
from typing import Any

import pymap3d
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.mavlink.wire.decode import decode
from companion.values import AdsbVehicle, AltitudeDatum, Frame, Source
from sitl_replay.flight import scenario
from sitl_replay.flight.payloads import GEOID_HEIGHT_M, PRESSURE_OFFSET_M
from sitl_replay.flight.relay import Aircraft, Valid, heard, relayed, squitters
from sitl_replay.flight.scenario import Scenario
from sitl_replay.flight.vehicles import schedule

SEED = 3
DURATION_S = 400.0


@pytest.fixture(scope="module")
def flight() -> Scenario:
    return scenario.adsb(4, SEED)


Told = tuple[float, bytes, Any]


@pytest.fixture(scope="module")
def told(flight: Scenario) -> dict[tuple[Source, int], list[Told]]:
    """By relay and aircraft: send time, frame, message decoded by pymavlink."""
    parser = dialect.MAVLink(None)
    found: dict[tuple[Source, int], list[Told]] = defaultdict(list)
    for t_s, vehicle, raw in schedule(flight, SEED, duration_s=DURATION_S):
        if raw[7:10] == b"\xf6\0\0":
            (message,) = parser.parse_buffer(raw)
            found[vehicle.source, message.ICAO_address].append((t_s, raw, message))
    return found


@pytest.fixture(scope="module")
def aircraft(flight: Scenario) -> dict[int, Aircraft]:
    return {one.icao: one for one in flight.uavs[0].hears}


def test_two_relays_report_the_same_aircraft_independently(
    told: dict[tuple[Source, int], list[Told]], aircraft: dict[int, Aircraft]
) -> None:
    assert set(told) == {(Source(n, 1), icao) for n in (1, 2) for icao in aircraft}
    assert len(aircraft) == 6
    for one in aircraft.values():
        first, second = (list(islice(heard(one, f"{n}:1", SEED), 60)) for n in (1, 2))
        # Most transmissions reach both relays, some only one; the content is the same.
        assert len(set(first) & set(second)) > 30
        assert set(first[:45]) - set(second)
        assert set(second[:45]) - set(first)
        times_s = [{at.t_s for at in islice(relayed(one, f"{n}:1", SEED), 50)} for n in (1, 2)]
        assert not times_s[0] & times_s[1]


def test_aircraft_transmit_once_per_second(aircraft: dict[int, Aircraft]) -> None:
    for one in aircraft.values():
        times_s = [contact.t_s for contact in islice(squitters(one, SEED), 300)]
        assert all(0.95 <= after - before <= 1.05 for before, after in pairwise(times_s))
        missed = len(times_s) - sum(
            contact.t_s <= times_s[-1] for contact in islice(heard(one, "1:1", SEED), 300)
        )
        assert 0.1 * 300 < missed < 0.35 * 300


def test_relay_interval_is_0_2_to_2_6_s_and_at_most_10_s(
    told: dict[tuple[Source, int], list[Told]],
) -> None:
    gaps_s = [after[0] - before[0] for found in told.values() for before, after in pairwise(found)]
    assert min(gaps_s) >= 0.2
    assert 5.0 < max(gaps_s) <= 10.0
    ordinary = sorted(gaps_s)[: int(0.9 * len(gaps_s))]
    assert ordinary[-1] <= 2.6
    assert sum(ordinary) / len(ordinary) > 1.0


def test_relayed_content_except_tslc_changes_only_on_contact(
    told: dict[tuple[Source, int], list[Told]], aircraft: dict[int, Aircraft]
) -> None:
    for (source, icao), found in told.items():
        meant = islice(relayed(aircraft[icao], str(source), SEED), len(found))
        same = 0
        for (t_s, _, message), plan in zip(found, meant, strict=True):
            assert t_s == plan.t_s
            assert message.tslc == math.floor(t_s - plan.contact.t_s)
            assert 0 <= message.tslc <= 3
        for before, after in pairwise(found):
            fields = [
                {key: value for key, value in told_at[2].to_dict().items() if key != "tslc"}
                for told_at in (before, after)
            ]
            same += fields[0] == fields[1]
        assert same > 0.1 * len(found)


def test_valid_fields_are_true_and_invalid_fields_random(
    flight: Scenario, told: dict[tuple[Source, int], list[Told]], aircraft: dict[int, Aircraft]
) -> None:
    garbage = defaultdict(set)
    for (source, icao), found in told.items():
        one = aircraft[icao]
        for (_, _, message), plan in zip(found, relayed(one, str(source), SEED), strict=False):
            motion = one.trajectory(plan.contact.t_s)
            north_mps, east_mps, down_mps = motion.velocity_ned_mps
            geometric = one.datum is AltitudeDatum.GEOMETRIC
            lat_deg, lon_deg, alt_m = pymap3d.ned2geodetic(*motion[0], *flight.origin)
            fields = {
                Valid.COORDS: [(message.lat / 1e7, lat_deg), (message.lon / 1e7, lon_deg)],
                Valid.ALTITUDE: [
                    (
                        message.altitude / 1e3,
                        alt_m + (GEOID_HEIGHT_M if geometric else PRESSURE_OFFSET_M),
                    ),
                    (message.altitude_type, float(geometric)),
                ],
                Valid.HEADING: [
                    (message.heading / 100, math.degrees(math.atan2(east_mps, north_mps)) % 360)
                ],
                Valid.VELOCITY: [(message.hor_velocity / 100, math.hypot(north_mps, east_mps))],
                Valid.VERTICAL_VELOCITY: [(message.ver_velocity / 100, -down_mps)],
                Valid.SQUAWK: [(message.squawk, 7000)],
            }
            for flag, read in fields.items():
                for value, meant in read:
                    if message.flags & flag:
                        tolerance = 1e-7 if flag is Valid.COORDS else 0.00501
                        assert value == pytest.approx(meant, abs=tolerance)
                    else:
                        garbage[flag].add(value)
            if message.flags & Valid.CALLSIGN:
                assert message.callsign == one.callsign
            assert message.emitter_type == one.emitter_type
    missing = {Valid.COORDS, Valid.ALTITUDE, Valid.HEADING, Valid.VELOCITY, Valid.VERTICAL_VELOCITY}
    assert set(garbage) == missing
    assert all(len(values) > 20 for values in garbage.values())


def test_heading_is_valid_only_for_moving_aircraft(
    told: dict[tuple[Source, int], list[Told]], aircraft: dict[int, Aircraft]
) -> None:
    told_courses = set()
    for (_, icao), found in told.items():
        if icao in (0xF00003, 0xF00004):
            continue
        for _, _, message in found:
            if message.hor_velocity != 10:  # 0.1 m/s, the limit itself
                stands = message.hor_velocity < 10
                told_courses.add((stands, bool(message.flags & Valid.HEADING)))
    assert told_courses == {(True, False), (False, True)}


def test_one_aircraft_is_sometimes_relayed_without_position(
    told: dict[tuple[Source, int], list[Told]],
) -> None:
    for (_, icao), found in told.items():
        flags = [message.flags for _, _, message in found]
        placeless = [flag for flag in flags if not flag & Valid.COORDS]
        if icao == 0xF00004:
            assert set(placeless) == {Valid.ALTITUDE | Valid.SQUAWK}
            assert 0.15 * len(flags) < len(placeless) < 0.5 * len(flags)
        else:
            assert not placeless


def test_service_decodes_relayed_aircraft_correctly(
    flight: Scenario, told: dict[tuple[Source, int], list[Told]]
) -> None:
    for (source, icao), found in told.items():
        for t_s, raw, message in found[:60]:
            read = decode(Frame(t_ns=round(t_s * 1e9), link="a", source=source, msgid=246, raw=raw))
            assert isinstance(read, AdsbVehicle)
            assert (read.position_deg is not None) == bool(message.flags & Valid.COORDS)
            if read.position_deg is None:
                continue
            assert read.uav == f"icao:{icao:06X}"
            assert (read.alt_m is None) == (icao == 0xF00005)
            # At the time given by tslc, its position is correct to one second of flight.
            (truth,) = flight.truth(read.uav, t_s - message.tslc - 0.5)
            north_m, east_m, _ = pymap3d.geodetic2ned(
                *read.position_deg, flight.origin.alt_m, *flight.origin
            )
            known = {Valid.HEADING, Valid.VELOCITY} <= set(Valid(message.flags))
            assert (read.velocity_ne_mps is not None) == known
            off_m = math.dist((north_m, east_m), truth.position_ned_m[:2])
            speed_mps = math.hypot(*truth.velocity_ned_mps)
            assert off_m <= 0.51 * speed_mps + 15.0


def test_one_aircraft_is_a_uav_of_the_fleet(
    flight: Scenario, aircraft: dict[int, Aircraft]
) -> None:
    twice = [
        (str(uav.source), str(one))
        for one in aircraft.values()
        for uav in flight.uavs
        if uav.trajectory(5.0) == one.trajectory(5.0)
    ]
    assert twice == [("3:1", "icao:F00006")]


def test_aircraft_use_both_altitude_datums_and_valid_callsigns(
    aircraft: dict[int, Aircraft],
) -> None:
    assert {one.datum for one in aircraft.values()} == {
        AltitudeDatum.PRESSURE,
        AltitudeDatum.GEOMETRIC,
    }
    assert all(len(one.callsign) <= 8 for one in aircraft.values())
    assert all(0 < one.icao < 1 << 24 for one in aircraft.values())
