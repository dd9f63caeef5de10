"""One name for each value in every output: the API, recordings and exports.

The outputs are compared on a flight. Two names with the same values are one value under two
names. A value missing from one output needs a reason, given with its description or here.
"""

import math
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from companion.node.replay import log_events
from companion.pipeline import assembly
from companion.pipeline.fold import Pipeline
from companion.recording import fields
from companion.recording.tables.columns import Table
from companion.settings.model import Settings
from companion.values import Update
from companion.values.described import Meaning, meaning, members
from companion.views import beam_state, uav_state
from companion.views.as_json import FORMER_NAMES, as_json, name_in_json
from companion.views.tables.said import TABLES
from companion.views.tables.updates import BeamRow, TrackRow

DERIVED = "computed when asked: a replay of the recording gives it"
OTHER_TOPIC = "in the recording's own topic /uav/{id}/predicted, as foxglove.LocationFix"
OF_THE_UPDATE = "the update has it: it is the same for all of its rows"
SUBJECTS: dict[str, dict[str, Any]] = {
    "track": {"api": uav_state.UavState, "recording": "Track", "export": TrackRow},
    "beam": {"api": beam_state.BeamState, "recording": "Beam", "export": BeamRow},
}
REASONS: dict[str, dict[str, dict[str, str]]] = {
    "track": {
        "recording": dict.fromkeys(
            ("id", "verdict", "health", "target", "served_by", "same_as", "callsign", "relays",
             "alt_datum", "fix", "north", "east", "down", "heading", "assumptions", "clock",
             "rejected", "recent_rejections", "bound_cylinder_ned", "bound_ellipsoid_ned",
             "left_out"), DERIVED)
        | dict.fromkeys(("lat", "lon", "alt"), OTHER_TOPIC),
        "export": dict.fromkeys(
            ("id", "verdict", "health", "target", "served_by", "same_as", "callsign", "relays",
             "alt_datum", "fix", "north", "east", "down", "heading", "assumptions", "clock",
             "rejected", "recent_rejections", "bound_cylinder_ned", "bound_ellipsoid_ned"),
            "of the present moment: reports, rejections and events are tables of their own"),
        "api": {
            "t": OF_THE_UPDATE,
            "left_out": "`left_out` of /v1/beams",
            "speed_max": "within `assumptions`", "acceleration_max": "within `assumptions`",
            "limits_source": "within `assumptions`",
        },
    },
    "beam": {
        "recording": dict.fromkeys(
            ("bearing", "above_horizon", "lat", "lon", "alt", "guaranteed_gain", "power", "cost",
             "guaranteed_sinr", "sinr", "codebook", "eirp"), DERIVED)
        | {"t": OF_THE_UPDATE, "valid_at": OF_THE_UPDATE},
        "export": dict.fromkeys(
            ("bearing", "above_horizon", "lat", "lon", "alt", "guaranteed_gain", "power", "cost",
             "guaranteed_sinr", "sinr", "codebook", "eirp"),
            "takes a search each: `companion weights LOG --at T` has it"),
        "api": {"t": OF_THE_UPDATE, "valid_at": OF_THE_UPDATE},
    },
}  # fmt: skip
SAME_THING = {
    frozenset({"id", "uav"}): "a UAV is `id` in its own entry, and `uav` where others name it",
    frozenset({"cost", "loss"}): "alike in this flight, whose beams have a single time slot",
}
UNITS = ("_degps", "_radps", "_mps2", "_mps", "_dbm", "_deg", "_rad", "_utc", "_ns", "_db", "_m",
         "_s")  # fmt: skip


def stem(name: str) -> str:
    """Return a name without its unit and axis: equal in every output."""
    for unit in UNITS:
        if name.endswith(unit):
            name = name.removesuffix(unit)
            break
    name = {"at": "t"}.get(name, name)
    for axis in ("_north", "_east", "_down"):
        name = name.removesuffix(axis)
    return name.removesuffix("_ned")


def names(subject: dict[str, Any]) -> dict[str, set[str]]:
    """Return the stems of a subject in each output; deprecated names are left out."""
    api = {
        stem(name_in_json(one.name)) for one in members(subject["api"])
        if "api" not in one.meaning.absent
    }  # fmt: skip
    recorded = {stem(one.name) for one in fields.fields(subject["recording"])}
    table = Table(name="", row_is="", row_class=subject["export"])
    return {"api": api, "recording": recorded, "export": {stem(one.name) for one in table.columns}}


@pytest.mark.parametrize("subject", SUBJECTS)
def test_values_missing_from_one_output_have_a_reason(subject: str) -> None:
    found, reasons = names(SUBJECTS[subject]), REASONS[subject]
    everything = set.union(*found.values())
    described = {stem(one.name): one.meaning.absent for one in members(SUBJECTS[subject]["export"])}
    normal = {way: {stem(name) for name in given} for way, given in reasons.items()}
    for way, has in found.items():
        lacks = {name for name in everything - has if way not in described.get(name, {})}
        assert lacks == normal[way], way


@pytest.fixture(scope="module")
def flown(cut_log: Path) -> tuple[Pipeline, Any, list[Update]]:
    """Return a pipeline after a flight, with updates in which each UAV has moved."""
    settings = Settings().override(center={"source": "5:1"})
    pipeline, updates = Pipeline(settings), list[Update]()
    for event in log_events([cut_log], settings):
        updates += [one for one in pipeline.step(event) if isinstance(one, Update)]
    return pipeline, assembly.equipment(settings, pipeline.array), updates[-40::8]


@pytest.fixture(scope="module")
def cut_log() -> Path:
    return Path(__file__).parent / "data" / "sitl_4circle_cut.tlog"


def radians_as_degrees(name: str, value: Any) -> Any:
    if name.endswith(("_rad", "_radps")) and value is not None:
        return math.degrees(value)
    return value


def columns(flown: tuple[Pipeline, Any, list[Update]]) -> dict[str, dict[str, list[Any]]]:
    """Return the values of all beams and tracks of a flight by name, in every output, angles in
    degrees."""
    pipeline, equipment, updates = flown
    found: dict[str, dict[str, list[Any]]] = {"track": defaultdict(list), "beam": defaultdict(list)}

    def add(subject: str, way: str, values: Iterator[tuple[str, Any]]) -> None:
        for name, value in values:
            found[subject][f"{way} {name}"].append(radians_as_degrees(name, value))

    for update in updates:
        shown = beam_state.beams(pipeline, equipment, update, age_s=0.0, lead_ms=0.0)["beams"]
        assert pipeline.local is not None
        for beam, entry in zip(update.beams.beams, shown, strict=True):
            track = next(one for one in update.tracks if one.uav == beam.uav)
            former = FORMER_NAMES["BeamState"]
            add("beam", "api", ((k, v) for k, v in entry.items() if k not in former))
            recorded = fields.values("Beam", beam)
            add("beam", "recording", iter(recorded.items()))
            add("track", "recording", iter(fields.values("Track", fields.RecordedTrack(
                track=track, t_ns=update.t_ns)).items()))  # fmt: skip
            place = pipeline.local.place(*track.position_ned_m.tolist())
            row = TrackRow(update=update, track=track, place=place, left_out=None)
            table = Table(name="", row_is="", row_class=TrackRow)
            add("track", "export", ((c.name, c.get(row)) for c in table.columns))
            own = as_json(track, pipeline.utc_ns)
            assert own["climb_rate_mps"] == -own["velocity_ned_mps"][2]
            add("track", "api", iter(own.items()))
    return found


def same(one: Any, other: Any) -> bool:
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=1e-9, abs_tol=1e-12)
    return bool(str(one) == str(other))


@pytest.mark.parametrize("subject", SUBJECTS)
def test_no_two_names_hold_the_same_values(
    flown: tuple[Pipeline, Any, list[Update]], subject: str
) -> None:
    found = columns(flown)[subject]
    telling = {
        name: values for name, values in found.items()
        if len({str(value) for value in values}) > len(values) // 2
    }  # fmt: skip
    assert len(telling) > 15
    twice = {
        frozenset({stem(one.split()[1]), stem(other.split()[1])})
        for one, values in telling.items()
        for other, others in telling.items()
        if stem(one.split()[1]) != stem(other.split()[1]) and all(map(same, values, others))
    }
    assert twice <= set(SAME_THING), twice - set(SAME_THING)


@pytest.mark.parametrize("subject", SUBJECTS)
def test_each_name_holds_the_same_values_in_every_output(
    flown: tuple[Pipeline, Any, list[Update]], subject: str
) -> None:
    """Angles in degrees; the recording has radians."""
    found = {
        name: values for name, values in columns(flown)[subject].items()
        if isinstance(values[0], float) and not re.search("_(north|east|down)_", name)
    }  # fmt: skip
    compared = 0
    for one, values in found.items():
        for other, others in found.items():
            if one != other and stem(one.split()[1]) == stem(other.split()[1]):
                assert all(map(same, values, others)), (one, other)
                compared += 1
    assert compared > 15


def test_column_names_are_unique_and_old_names_point_to_new_ones() -> None:
    for table in TABLES:
        named = [column.name for column in table.columns]
        assert len(named) == len(set(named))
        for old, new in table.former_names.items():
            (column,) = (one for one in table.columns if one.name == old)
            assert new in named and column.meaning == f"deprecated: use `{new}`"


def test_each_value_has_one_description_for_every_output() -> None:
    """It is described once: every output refers to the same object."""
    for name in ("innovation_m", "bound_m", "age_s"):
        said = meaning(TrackRow, name)
        assert isinstance(said, Meaning)
        assert meaning(uav_state.UavState, name) is said
