"""Coverage of the array: rejection reasons by hand, and margins against randomly drawn caps."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import examples

from companion.beams.array.coverage import Coverage, Sector, margin_rad, refusals
from companion.values import FloatArray

SEEDS = st.integers(0, 2**32 - 1)


def rad(*degrees: float) -> tuple[float, ...]:
    return tuple(math.radians(angle) for angle in degrees)


def sector(*degrees: float) -> Sector:
    azimuth_from_rad, azimuth_to_rad, elevation_from_rad, elevation_to_rad = rad(*degrees)
    return Sector(
        azimuth_from_rad=azimuth_from_rad,
        azimuth_to_rad=azimuth_to_rad,
        elevation_from_rad=elevation_from_rad,
        elevation_to_rad=elevation_to_rad,
    )


def towards(azimuth_deg: float, elevation_deg: float) -> FloatArray:
    azimuth, elevation = rad(azimuth_deg, elevation_deg)
    level = math.cos(elevation)
    return np.array([level * math.cos(azimuth), level * math.sin(azimuth), -math.sin(elevation)])


BOX = sector(30, 60, -90, 0)
FRONT = towards(0, 0)


def why(coverage: Coverage, in_array: FloatArray, in_body: FloatArray) -> str | None:
    (reason,) = refusals(coverage, in_array[np.newaxis], in_body[np.newaxis])
    return reason


def limited(azimuths_deg: tuple[float, float], elevations_deg: tuple[float, float]) -> Coverage:
    azimuths, elevations = np.radians(azimuths_deg), np.radians(elevations_deg)
    return Coverage(
        field_of_view_rad=None,
        azimuth_limits_rad=(float(azimuths[0]), float(azimuths[1])),
        elevation_limits_rad=(float(elevations[0]), float(elevations[1])),
    )


@pytest.mark.parametrize(
    ("coverage", "in_array", "in_body", "reason"),
    [
        (Coverage(), towards(180, 0), towards(0, -90), None),
        (
            Coverage(field_of_view_rad=math.radians(120)),
            towards(0, 62),
            FRONT,
            "62 degrees off boresight, outside the field of view of 120",
        ),
        (Coverage(field_of_view_rad=math.radians(120)), towards(-59.9, 0), FRONT, None),
        (Coverage(field_of_view_rad=2 * math.pi), towards(180, 0), FRONT, None),
        (
            Coverage(azimuth_limits_rad=rad(-60, 45.5)),  # type: ignore[arg-type]
            towards(46, 10),
            FRONT,
            "azimuth 46 degrees, outside the steering limits of -60 to 45.5",
        ),
        (
            Coverage(elevation_limits_rad=rad(-30, 0)),  # type: ignore[arg-type]
            towards(-170, 0.26),
            FRONT,
            "elevation 0.3 degrees, outside the steering limits of -30 to 0",
        ),
        (
            Coverage(hidden=(sector(-10, 10, 20, 40), BOX)),
            FRONT,
            towards(45, -20),
            "hidden by the airframe (azimuth 30 to 60, elevation -90 to 0)",
        ),
        (Coverage(hidden=(BOX,)), towards(45, -20), towards(45, 1), None),
        (Coverage(hidden=(BOX,)), towards(45, -20), towards(29, -20), None),
        (
            Coverage(hidden=(sector(170, -170, -10, 10),)),
            FRONT,
            towards(180, 0),
            "hidden by the airframe (azimuth 170 to -170, elevation -10 to 10)",
        ),
        (Coverage(hidden=(sector(170, -170, -10, 10),)), FRONT, towards(169, 0), None),
        (
            Coverage(hidden=(sector(-180, -170, -10, 10),)),
            FRONT,
            towards(180, 0),  # 180 and -180 degrees are equal
            "hidden by the airframe (azimuth -180 to -170, elevation -10 to 10)",
        ),
    ],
)
def test_direction_outside_one_limit_gets_its_reason(
    coverage: Coverage, in_array: FloatArray, in_body: FloatArray, reason: str | None
) -> None:
    assert why(coverage, in_array, in_body) == reason
    margin = margin_rad(coverage, in_array, in_body)
    assert (margin > 0) == (reason is None)
    assert isinstance(margin, float)


def test_first_violated_limit_is_reported_per_direction() -> None:
    coverage = Coverage(
        field_of_view_rad=math.radians(90),
        azimuth_limits_rad=rad(-30, 30),
        elevation_limits_rad=None,
        hidden=(BOX,),
    )  # type: ignore[arg-type]
    places = np.array([towards(50, 0), towards(40, 0), towards(0, 40), towards(0, 1)])
    body = np.array([towards(45, -5), towards(45, -5), towards(45, -5), FRONT])
    found = refusals(coverage, places, body)
    assert found[0] == "50 degrees off boresight, outside the field of view of 90"
    assert found[1] == "azimuth 40 degrees, outside the steering limits of -30 to 30"
    assert found[2] == f"hidden by the airframe ({BOX})"
    assert found[3] is None
    assert refusals(coverage, places[:0], body[:0]) == []


@pytest.mark.parametrize(
    ("coverage", "in_array", "in_body", "margin_deg"),
    [
        (Coverage(), FRONT, FRONT, math.inf),
        (Coverage(field_of_view_rad=2 * math.pi), towards(180, 0), FRONT, math.inf),
        (Coverage(field_of_view_rad=math.radians(300)), towards(0, 90), FRONT, 60.0),
        (limited((-180, 180), (-90, 90)), FRONT, FRONT, math.inf),
        (limited((-180, 180), (-90, 60)), towards(77, 20), FRONT, 40.0),
        (
            limited((-180, 180), (-90, 60)),
            towards(77, -90),
            FRONT,
            150.0,
        ),  # a pole does not count as an edge
        (limited((-60, 30), (-90, 90)), FRONT, FRONT, 30.0),
        (limited((-60, 30), (-90, 90)), towards(0, 90), FRONT, 0.0),  # a corner does
        (limited((150, -150), (-90, 90)), towards(-170, 0), FRONT, 20.0),
        (Coverage(hidden=(BOX,)), FRONT, towards(45, 7), 7.0),
        (Coverage(hidden=(BOX,)), FRONT, towards(10, 0), 20.0),
        (
            Coverage(hidden=(BOX,)),
            FRONT,
            towards(-135, 0),
            90.0,
        ),  # behind: the pole is the nearest edge
        (Coverage(hidden=(sector(-180, 180, 30, 90),)), FRONT, towards(10, -90), 120.0),
        (Coverage(hidden=(sector(170, -170, -10, 10),)), FRONT, towards(180, 15), 5.0),
        (Coverage(hidden=(sector(170, -170, -10, 10),)), FRONT, towards(180, 10), 0.0),
    ],
)
def test_margins_match_hand_computed_values(
    coverage: Coverage, in_array: FloatArray, in_body: FloatArray, margin_deg: float
) -> None:
    assert np.degrees(margin_rad(coverage, in_array, in_body)) == pytest.approx(
        margin_deg, abs=1e-9
    )


def drawn(rng: np.random.Generator) -> Sector:
    """Draw any sector: thin ones, around a pole, across 180 degrees, over all azimuths."""
    low, high = np.sort(rng.choice([-90.0, 90.0, *rng.uniform(-90, 90, 3)], 2, replace=False))
    if rng.random() < 0.2:
        return sector(-180, 180, low, high)
    start = rng.uniform(-180, 180)
    width = rng.choice([rng.uniform(2, 5), rng.uniform(5, 180), rng.uniform(180, 359)])
    return sector(start, (start + width + 180) % 360 - 180, low, high)


def edge(of: Sector, points: int) -> FloatArray:
    """Return directions along the whole edge of a sector."""
    share = np.linspace(0, 1, points)
    azimuths = of.azimuth_from_rad + share * of.width_rad
    low, high = of.elevation_from_rad, of.elevation_to_rad
    rows = [(azimuths[:0], azimuths[:0])]
    if of.width_rad < 2 * math.pi:
        along = low + share * (high - low)
        rows += [(azimuths[:1].repeat(points), along), (azimuths[-1:].repeat(points), along)]
    rows += [(azimuths, np.full(points, e)) for e in (low, high) if abs(e) < math.pi / 2]
    azimuth, elevation = (np.concatenate(part) for part in zip(*rows, strict=True))
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), -np.sin(elevation)], axis=1)


def about(direction: FloatArray, radius: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return random directions at angles ``radius`` (N,) from a given one."""
    aside = rng.standard_normal((len(radius), 3))
    aside -= (aside @ direction)[:, np.newaxis] * direction
    aside /= np.linalg.norm(aside, axis=1)[:, np.newaxis]
    return np.cos(radius)[:, np.newaxis] * direction + np.sin(radius)[:, np.newaxis] * aside


def random_direction(rng: np.random.Generator, near: FloatArray) -> FloatArray:
    """Return a direction anywhere, straight up, straight behind, or close to a given one."""
    if rng.random() < 0.2:
        poles = np.array([[0, 0, 1], [0, 0, -1], [-1, 0, 0], [-1, -0.0, 0], [0, 1, 0.0]])
        return poles[rng.integers(5)]
    drawn = rng.standard_normal(3)
    if rng.random() < 0.5:
        drawn = near[rng.integers(len(near))] + rng.choice([0.3, 0.03]) * drawn
    unit: FloatArray = drawn / np.linalg.norm(drawn)
    return unit


def cone_edge(half_rad: float, points: int) -> FloatArray:
    around = np.linspace(0, 2 * np.pi, points)
    across = math.sin(half_rad)
    return np.stack(
        [np.full(points, math.cos(half_rad)), across * np.cos(around), across * np.sin(around)],
        axis=1,
    )


@given(SEEDS)
@settings(max_examples=examples(300), deadline=None)
def test_margin_equals_angle_to_nearest_coverage_edge(seed: int) -> None:
    """All limits combined, with the array mounted at random on the body."""
    rng = np.random.default_rng(seed)
    view = float(rng.uniform(0.5, 2 * math.pi)) if rng.random() < 0.3 else None
    steered = drawn(rng)
    azimuths = (steered.azimuth_from_rad, steered.azimuth_to_rad)
    elevations = (steered.elevation_from_rad, steered.elevation_to_rad)
    coverage = Coverage(
        field_of_view_rad=view,
        azimuth_limits_rad=azimuths if rng.random() < 0.4 else None,
        elevation_limits_rad=elevations if rng.random() < 0.4 else None,
        hidden=tuple(drawn(rng) for _ in range(rng.integers(4))),
    )
    array_from_body = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    array_from_body[0] *= np.linalg.det(array_from_body)
    in_array = [edge(coverage.limits(), 1500)]
    in_array += [] if view is None else [cone_edge(view / 2, 1500)]
    edges = [part @ array_from_body for part in in_array]  # in the body frame
    edges += [edge(hides, 1500) for hides in coverage.hidden]
    border = np.concatenate(edges)
    body = random_direction(rng, border if len(border) else np.eye(3))
    margin = float(margin_rad(coverage, array_from_body @ body, body))
    if why(coverage, array_from_body @ body, body) is not None:
        assert margin == 0
        return
    gaps = np.linalg.norm(border - body, axis=1) / 2
    nearest = float(2 * np.arcsin(min(gaps.min(initial=1.0), 1.0)))
    assert min(margin, math.pi) <= nearest + 1e-7
    assert min(margin, math.pi) == pytest.approx(nearest, abs=5e-3)  # between points of the edge
    if margin > 1e-6:
        radius = (min(margin, math.pi) - 1e-9) * np.append(np.sqrt(rng.random(200)), [1.0] * 100)
        inside = about(body, radius, rng)
        assert set(refusals(coverage, inside @ array_from_body.T, inside)) == {None}


def test_sector_formats_its_limits_in_degrees() -> None:
    assert str(sector(-0.04, 29.96, -12.34, 90)) == "azimuth 0 to 30, elevation -12.3 to 90"


def test_margins_accept_arrays_of_any_shape() -> None:
    rng = np.random.default_rng(5)
    directions = rng.standard_normal((4, 5, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    coverage = Coverage(
        field_of_view_rad=math.radians(200),
        azimuth_limits_rad=None,
        elevation_limits_rad=None,
        hidden=(BOX,),
    )
    found = margin_rad(coverage, directions, directions)
    assert found.shape == (4, 5)
    assert found[2, 3] == margin_rad(coverage, directions[2, 3], directions[2, 3])
    turned = refusals(coverage, directions[0], directions[0])
    assert [reason is None for reason in turned] == list(found[0] > 0)


@pytest.mark.parametrize(
    ("degrees", "reason"),
    [
        ((-181, 10, 0, 10), "azimuth -181 to 10 degrees: give angles from -180 to 180"),
        ((0, 180.1, 0, 10), "azimuth 0 to 180.1 degrees: give angles from -180 to 180"),
        ((math.nan, 10, 0, 10), "azimuth nan to 10 degrees: give angles from -180 to 180"),
        ((30, 30, 0, 10), "azimuth 30 to 30 degrees: give a range above 0 degrees"),
        ((180, -180, 0, 10), "azimuth 180 to -180 degrees: give a range above 0 degrees"),
        ((0, 10, 20, 10), "elevation 20 to 10 degrees: give ascending angles from -90 to 90"),
        ((0, 10, 10, 10), "elevation 10 to 10 degrees: give ascending angles from -90 to 90"),
        ((0, 10, -91, 10), "elevation -91 to 10 degrees: give ascending angles from -90 to 90"),
        ((0, 10, 0, 90.1), "elevation 0 to 90.1 degrees: give ascending angles from -90 to 90"),
        ((0, 10, 0, math.nan), "elevation 0 to nan degrees: give ascending angles from -90 to 90"),
    ],
)
def test_invalid_sector_is_rejected(degrees: tuple[float, ...], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        sector(*degrees)


@pytest.mark.parametrize("degrees", [0.0, -10.0, 360.1, math.nan, math.inf])
def test_invalid_field_of_view_is_rejected(degrees: float) -> None:
    with pytest.raises(
        ValueError, match=r"field of view .* degrees: give more than 0, at most 360"
    ):
        Coverage(field_of_view_rad=math.radians(degrees))


def test_invalid_steering_limits_are_rejected() -> None:
    with pytest.raises(ValueError, match="steering limits: azimuth 10 to 10 degrees: give a range"):
        limited((10, 10), (-90, 90))
    with pytest.raises(
        ValueError,
        match="steering limits: elevation 10 to -10 degrees: give ascending angles from -90 to 90",
    ):
        limited((-180, 180), (10, -10))
