"""Every numeric setting has limits; at its limits a flight runs or fails with one line."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import pytest

from companion.node.replay import Run
from companion.pipeline.ticks import with_ticks
from companion.recording.reader import read_log
from companion.recording.writer import Writer
from companion.settings.model import REPLAYED_SECTIONS, Settings
from companion.values import Event, UserError

FLOWN_NS: Final = 4_000_000_000
CENTER: Final = "5:1"
GOES_WITH: Final[dict[str, dict[str, object]]] = {
    "array.rows": {"kind": "ura", "columns": 2},
    "array.columns": {"kind": "ura", "rows": 2},
    "array.positions_m": {"kind": "list"},
    "array.element_exponent": {"element": "cosine"},
    "array.mount_pitch_deg": {"element": "3gpp"},
    "array.hidden_deg": {"field_of_view_deg": 170.0},
    "beams.regularisation": {"method": "rzf"},
    "beams.loss_limit_db": {"policy": "group"},
    "beams.condition_limit": {"policy": "drop"},
    "beams.rate_weights": {"power": "weighted-sum"},
    "codebook.oversampling": {"kind": "dft"},
    "observer.alpha": {"model": "position"},
    "observer.feedthrough_s": {"model": "position"},
    "observer.velocity_lead_s": {"model": "position"},
    "observer.geoid_error_m": {"geoid_m": 40.0},
}
"""Other settings that a key requires to take effect."""
BESIDE: Final[dict[str, dict[str, dict[str, object]]]] = {
    "radio": {"beams": {"method": "mmse", "power": "max-min"}, "link": {"needed_sinr_db": 10.0}},
    "link": {"beams": {"method": "mmse", "widen": "guarantee"}},
    "hardware": {"hardware": {"device": "adar1000"}, "array": {"elements": 8}},
    "codebook": {"array": {"elements": 8}},
}
SCHEMA: Final = Settings.model_json_schema()


def referred(schema: dict[str, Any]) -> dict[str, Any]:
    name = schema.get("$ref", "").removeprefix("#/$defs/")
    return SCHEMA["$defs"][name] if name else schema


def numbers(schema: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Return the schemas of all numbers in a value."""
    schema = referred(schema)
    if schema.get("type") in ("number", "integer"):
        yield schema
    for each in schema.get("anyOf", ()):
        yield from numbers(each)
    for each in (schema.get("items"), schema.get("additionalProperties")):
        if isinstance(each, dict):
            yield from numbers(each)
    for each in (*schema.get("prefixItems", ()), *schema.get("properties", {}).values()):
        yield from numbers(each)


def ends(schema: dict[str, Any]) -> tuple[float, float]:
    """Return the smallest and largest number that a schema allows."""
    least, greatest = schema.get("minimum"), schema.get("maximum")
    if least is None:
        least = math.nextafter(schema["exclusiveMinimum"], math.inf)
    if greatest is None:
        greatest = math.nextafter(schema["exclusiveMaximum"], -math.inf)
    return least, greatest


def extremes(schema: dict[str, Any]) -> Iterator[object]:
    """Return values at their limits: one number, or all numbers of a list."""
    schema = referred(schema)
    if schema.get("type") in ("number", "integer"):
        yield from ends(schema)
    for each in schema.get("anyOf", ()):
        yield from extremes(each)
    if fixed := schema.get("prefixItems"):
        sides = [ends(referred(each)) for each in fixed]
        yield from ([side[end] for side in sides] for end in (0, 1))
        yield [side[n % 2] for n, side in enumerate(sides)]
    elif isinstance(schema.get("items"), dict):
        inner = referred(schema["items"])
        rows = inner.get("type") == "array" and "prefixItems" not in inner
        for value in extremes(inner):
            yield [[0, 0, 0], 3 * value] if rows and isinstance(value, list) else [value]
    if isinstance(each := schema.get("additionalProperties"), dict):
        allowed = schema.get("propertyNames", {}).get("enum", ["1:1"])
        yield from ({allowed[0]: value} for value in extremes(each))
    for name, each in schema.get("properties", {}).items():
        yield from ({name: value} for value in extremes(each))


def keys() -> dict[str, dict[str, Any]]:
    """Return the schemas of all numeric keys, by section and name."""
    found = {}
    for section, each in SCHEMA["properties"].items():
        for name, schema in referred(each)["properties"].items():
            if any(numbers(schema)):
                found[f"{section}.{name}"] = schema
    return found


@pytest.mark.parametrize("key", keys())
def test_every_numeric_setting_has_limits(key: str) -> None:
    for schema in numbers(keys()[key]):
        assert schema.keys() & {"minimum", "exclusiveMinimum"}
        assert schema.keys() & {"maximum", "exclusiveMaximum"}


@pytest.fixture(scope="module")
def flight() -> list[Event]:
    """Return some seconds of five vehicles and relayed aircraft, with ticks."""
    log = Path(__file__).parents[1] / "data" / "sitl_4circle_cut.tlog"
    events = list(with_ticks(read_log(log), 2.5))
    return [event for event in events if event.t_ns - events[0].t_ns < FLOWN_NS]


def flown(settings: Settings, flight: list[Event], path: Path) -> int:
    """Process and record a flight; return the number of updates with beams."""
    run, beams = Run(settings, None), 0
    run.writer = Writer(
        where=path,
        settings_toml=settings.to_toml(),
        versions={},
        weights_hz=None,
        started_ns=flight[0].t_ns,
    )
    for event in flight:
        run.step(event)
        update = run.pipeline.last_update
        beams += update is not None and update.beams is not None
    run.finish()
    return beams


def test_limit_flight_produces_beams(flight: list[Event], tmp_path: Path) -> None:
    settings = Settings().override(center={"source": CENTER})
    assert flown(settings, flight, tmp_path / "x.mcap") > 0


@pytest.mark.parametrize("key", [key for key in keys() if key.split(".")[0] in REPLAYED_SECTIONS])
def test_setting_at_its_limit_runs_or_fails_in_one_line(
    flight: list[Event], tmp_path: Path, key: str
) -> None:
    section, name = key.split(".")
    for number, value in enumerate(extremes(keys()[key])):
        beside = {"center": {"source": CENTER}} | BESIDE.get(section, {})
        beside[section] = beside.get(section, {}) | GOES_WITH.get(key, {}) | {name: value}
        try:
            flown(Settings().override(**beside), flight, tmp_path / f"{number}.mcap")
        except UserError as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize("section", ["observer", "tracks", "clocks", "radio", "hardware"])
@pytest.mark.parametrize("end", [0, 1])
def test_all_limits_of_a_section_run_together(
    flight: list[Event], tmp_path: Path, section: str, end: int
) -> None:
    given = {"window_s": 60.0} if section == "tracks" else {}  # a log holds no more anyway
    for key, schema in keys().items():
        if key.startswith(f"{section}.") and key not in ("observer.alpha", "tracks.window_s"):
            given[key.split(".")[1]] = list(extremes(schema))[end]
    beside = {"center": {"source": CENTER}} | BESIDE.get(section, {})
    beside[section] = beside.get(section, {}) | given
    flown(Settings().override(**beside), flight, tmp_path / "x.mcap")


@pytest.mark.parametrize("source", ["90,180,100000,360", "-90,-180,-100000,-360", "0,0,0"])
def test_station_at_extreme_positions_runs(
    flight: list[Event], tmp_path: Path, source: str
) -> None:
    flown(Settings().override(center={"source": source}), flight, tmp_path / "x.mcap")
