"""The kinematic design: its certificate, its bounds against adversaries, and its JSON form."""

import json
import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from hypothesis import given
from hypothesis import strategies as st
from support import ROOT, rounds

from companion.cli.main import main
from companion.tracking.design import answers, gain_table, lmi
from companion.tracking.design.answers import KinematicLimits
from companion.tracking.design.gain_table import DesignError, KinematicDesign
from companion.values import FloatArray

NAMES = ("kinematic_default", "kinematic_no_velocity")
FOLDERS = (Path(gain_table.__file__).parent, ROOT / "tests" / "data")
SPEED_MPS = 60.0


def designed(folder: Path, name: str) -> KinematicDesign:
    """Return the shipped table, and one for senders without velocity."""
    return KinematicDesign.from_json((folder / f"{name}.json").read_text(encoding="utf-8"))


DESIGNS = [designed(*place) for place in zip(FOLDERS, NAMES, strict=True)]
WITH_VELOCITY, WITHOUT = DESIGNS
EACH = pytest.mark.parametrize("design", DESIGNS, ids=NAMES)


# --- model --------------------------------------------------------------------------------------


@given(st.floats(0.05, 3.0), st.integers(0, 2**32 - 1))
def test_input_model_covers_every_bounded_acceleration(dt_s: float, seed: int) -> None:
    """Any a(s) in 3-D with |a| <= 5 is B w with |w| <= 1; exact integrals of 40 pieces."""
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((40, 3)) * rng.choice([1.0, 1e-3], (40, 1))
    a *= 5.0 / np.linalg.norm(a, axis=1)[:, None]
    if seed % 2:
        a[: seed % 40] *= -1
        a[:, 1:] = 0.0
    edges = np.linspace(0.0, dt_s, 41)
    lever = (edges[1:] ** 2 - edges[:-1] ** 2)[:, None] / 2  # integral of T - s, piecewise
    g = np.array([(lever * a).sum(axis=0), (np.diff(edges)[:, None] * a).sum(axis=0)])
    b, _, channels = gain_table.inputs(dt_s, 5.0, 0.5, 0.2)
    assert channels == (2, 1, 1)
    w = np.linalg.solve(b[:, :2], g)
    assert np.linalg.norm(w) <= 1 + 1e-9
    assert np.linalg.norm(g[0]) <= 5 * dt_s**2 / 2 * (1 + 1e-9)
    assert np.linalg.norm(g[1]) <= 5 * dt_s * (1 + 1e-9)


def worst_level(p: FloatArray, gain: FloatArray, dt_s: float) -> float:
    """Return sup sqrt(e+^T P e+) from the invariant set with freely switching acceleration, by
    support functions."""
    root = np.linalg.cholesky(p).T
    r = gain.shape[1]
    closed = gain_table.transition(dt_s) - gain @ np.eye(2)[:r]
    u = np.linspace(0.0, dt_s, 4001)
    levels = []
    for angle in np.linspace(0.0, math.pi, 361):
        c = root.T @ [math.cos(angle), math.sin(angle)]
        swept = 5.0 * np.trapezoid(np.abs(c[0] * u + c[1]), u)
        noise = np.abs(c @ gain) @ np.array([0.5, 0.2])[:r]
        levels.append(np.sqrt(c @ closed @ np.linalg.solve(p, closed.T @ c)) + noise + swept)
    return float(max(levels))


@pytest.mark.parametrize(("noise", "alpha"), [(0.2, 0.9), (None, 0.6)])
def test_constant_acceleration_model_misses_switching_accelerations(
    noise: float | None, alpha: float
) -> None:
    """With B = [T^2/2; T] alone the error leaves the set when the acceleration switches; with this
    B never."""
    b, d, channels = gain_table.inputs(1.0, 5.0, 0.5, noise)
    c, position = np.eye(2)[: len(d)], np.array([[1.0, 0.0]])
    a = gain_table.transition(1.0)
    ours = lmi.solve(a, b=b, c=c, d=d, h=position, alpha=alpha, channels=channels)
    assert worst_level(ours.lyapunov, ours.gain, 1.0) <= 1
    held = lmi.solve(
        a,
        b=np.delete(b, 1, 1),
        c=c,
        d=np.delete(d, 1, 1),
        h=position,
        alpha=alpha,
        channels=[1, *channels[1:]],
    )
    assert worst_level(held.lyapunov, held.gain, 1.0) > 1.1


# --- the certificate ----------------------------------------------------------------------------


@EACH
def test_shipped_tables_verify_quickly(design: KinematicDesign) -> None:
    assert gain_table.verify(design) == pytest.approx(design.margin, rel=1e-6)
    assert design.margin > 5e-5
    assert (design.dt_s[0], design.dt_s[-1]) == (0.05, 2.0)
    assert (design.acceleration_mps2, design.position_noise_m) == (5.0, 0.5)
    assert np.all((design.alphas > 0) & (design.alphas < 1))
    taken = []
    for _ in range(5):
        start = time.perf_counter()
        gain_table.verify(design)
        taken.append(time.perf_counter() - start)
    assert min(taken) < 0.010


@EACH
def test_table_margin_equals_the_lmi_margin(design: KinematicDesign) -> None:
    """At each grid point, against the general certificate in ``lmi``."""
    margins = []
    position = np.array([[1.0, 0.0]])
    sizes = (design.acceleration_mps2, design.position_noise_m, design.velocity_noise_mps)
    mu = gain_table.invariant_bound(design) ** 2 * 1.1
    for dt_s, gain, shares in zip(design.dt_s, design.gains, design.multipliers, strict=True):
        b, d, channels = gain_table.inputs(dt_s, *sizes)
        plant = (gain_table.transition(dt_s), b, np.eye(2)[: len(d)], d, position)
        margins.append(
            lmi.lmi_margin(
                design.p,
                gain=gain,
                mu=mu,
                plant=plant,
                alpha=sum(shares),
                shares=np.repeat(shares, channels),
            )
        )
        assert gain_table.gain(design, dt_s) == pytest.approx(gain)
    assert design.margin - 1e-9 <= min(margins) == pytest.approx(design.margin, abs=1e-5)


@EACH
def test_certificate_rejects_altered_tables(design: KinematicDesign) -> None:
    p11, p12, p22 = design.lyapunov
    wrong = list(design.corrections)
    wrong[12] = tuple(1.5 * x for x in wrong[12])
    for bad in (
        replace(design, corrections=tuple(wrong)),
        replace(design, acceleration_mps2=1.05 * design.acceleration_mps2),
        replace(design, lyapunov=(1.05 * p11, 1.05 * p12, 1.05 * p22)),
        replace(design, multipliers=tuple(tuple(0.9 * x for x in y) for y in design.multipliers)),
    ):
        with pytest.raises(DesignError, match="fails its certificate"):
            gain_table.verify(bad)


def test_certificate_is_checked_between_grid_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """A grid of two end points passes at them and is rejected for the intervals between."""
    ends = replace(
        WITHOUT,
        dt_s=WITHOUT.dt_s[::23],
        corrections=WITHOUT.corrections[::23],
        multipliers=WITHOUT.multipliers[::23],
    )
    with pytest.raises(DesignError, match="fails its certificate"):
        gain_table.verify(ends)
    monkeypatch.setattr(gain_table, "CHECKS_PER_STEP", 1)
    assert gain_table.verify(ends) > 0


@EACH
def test_gains_are_interpolated_and_clamped_at_the_ends(design: KinematicDesign) -> None:
    low, high = design.dt_s[3], design.dt_s[4]
    middle = gain_table.correction(design, (low + high) / 2)
    assert middle == pytest.approx(np.mean(design.corrections[3:5], axis=0))
    assert gain_table.correction(design, 0.01) == design.corrections[0]
    assert gain_table.correction(design, 30.0) == design.corrections[-1]
    m = np.reshape(design.corrections[-1], (2, -1))
    assert gain_table.gain(design, 30.0) == pytest.approx(np.array([[1, 30.0], [0, 1]]) @ m)


def test_the_invariant_bound_is_the_largest_on_the_ellipse() -> None:
    angles = np.linspace(0, 2 * math.pi, 100_001)
    circle = np.array([np.cos(angles), np.sin(angles)])
    e = np.linalg.solve(np.linalg.cholesky(WITH_VELOCITY.p).T, circle)
    for c in ((1.0, 0.0), (0.0, 1.0), (1.0, 0.7)):
        expected = np.max(np.abs(np.array(c) @ e))
        assert gain_table.invariant_bound(WITH_VELOCITY, c) == pytest.approx(expected, rel=1e-6)


# --- adversaries --------------------------------------------------------------------------------


def swept(c: FloatArray, dt_s: FloatArray, acceleration: float) -> FloatArray:
    """Return g (2, S) that is largest along c (2, S): bang-bang, switching once at T - s = -c_v /
    c_p."""
    with np.errstate(divide="ignore", invalid="ignore"):
        at = -c[1] / c[0]
    switches = (at > 0) & (at < dt_s)
    p = np.where(switches, dt_s**2 / 2 - at**2, dt_s**2 / 2)
    v = np.where(switches, dt_s - 2 * at, dt_s)
    sign = np.where(switches, np.sign(c[0]), np.sign(c[0] * dt_s / 2 + c[1]))
    return np.asarray(acceleration * sign * np.array([p, v]))


def step(design: KinematicDesign, e: FloatArray, dt_s: FloatArray, c: FloatArray) -> FloatArray:
    """Return the largest e+ (2, S) along c (2, S)."""
    r = 2 if design.has_velocity else 1
    noise = np.array([design.position_noise_m, design.velocity_noise_mps or 0.0])[:r]
    gains = np.array([gain_table.gain(design, float(x)) for x in dt_s])
    a = np.array([gain_table.transition(float(x)) for x in dt_s])
    pushed = np.einsum("ks,skr->sr", c, gains)
    closed = a - gains @ np.eye(2)[:r]
    free = np.einsum("sij,js->is", closed, e)
    c = c * np.where(np.sum(c * free, axis=0) < 0, -1.0, 1.0)
    pushed = np.einsum("ks,skr->sr", c, gains)
    entered = np.einsum("sij,sj->is", gains, np.sign(pushed) * noise)
    return np.asarray(free + entered + swept(c, dt_s, design.acceleration_mps2))


def closed_along(design: KinematicDesign, c: FloatArray, dt_s: FloatArray) -> FloatArray:
    """Return (A - L C)^T c: the direction of the present error that lies along c after the
    interval."""
    r = 2 if design.has_velocity else 1
    closed = [
        gain_table.transition(float(x)) - gain_table.gain(design, float(x)) @ np.eye(2)[:r]
        for x in dt_s
    ]
    return np.asarray(np.einsum("sji,js->is", np.array(closed), c))


@EACH
def test_adversaries_stay_in_the_invariant_set(design: KinematicDesign) -> None:
    """Hundreds of sequences of 40 intervals in the range, each planned backwards from a goal."""
    rng = np.random.default_rng(7)
    sequences, steps = rounds(400, 2000), 40
    dt_s = np.exp(rng.uniform(np.log(0.05), np.log(2.0), (steps, sequences)))
    dt_s[:, ::4] = dt_s[:1, ::4]  # a quarter of them keep their interval
    dt_s[:, 1::4] = np.where(rng.random(dt_s[:, 1::4].shape) < 0.5, 0.05, 2.0)
    goal = np.zeros((steps + 1, 2, sequences))
    goal[-1] = [np.ones(sequences), rng.choice([0.0, 0.0, 1.0, -1.0], sequences)]
    for k in reversed(range(steps)):
        goal[k] = closed_along(design, goal[k + 1], dt_s[k])
    along = goal[0] + 1e-300
    on_set = np.linalg.solve(design.p, along)
    on_set /= np.sqrt(np.sum(along * on_set, axis=0))
    invariant_m = gain_table.invariant_bound(design)
    for k in range(steps):
        on_set = step(design, on_set, dt_s[k], goal[k + 1])
        assert np.max(np.einsum("is,ij,js->s", on_set, design.p, on_set)) <= 1 + 1e-9
        assert np.max(np.abs(on_set[0])) <= invariant_m * (1 + 1e-9)


@EACH
@pytest.mark.parametrize("dt_s", [0.05, 0.1, 0.25, 1.0, 2.0])
def test_single_interval_peak_is_attained_but_not_exceeded(
    design: KinematicDesign, dt_s: float
) -> None:
    """The exact peak of ``companion design`` is attained by the adversary and never exceeded."""
    limits = KinematicLimits(
        design.acceleration_mps2, design.position_noise_m, design.velocity_noise_mps
    )
    peak_m = answers.peak_error_m(dt_s, gain_table.gain(design, dt_s), limits)
    steps, interval = 600, np.array([dt_s])
    goals = [np.array([[1.0], [0.0]])]
    for _ in range(steps):
        goals.append(closed_along(design, goals[-1], interval))
    e = np.zeros((2, 1))
    for goal in reversed(goals[:-1]):
        # Signs depend on the goal alone: the error so far already lies along it.
        e = step(design, e, interval, goal)
    assert abs(e[0, 0]) == pytest.approx(peak_m, rel=1e-6)
    assert peak_m < gain_table.invariant_bound(design)


# --- JSON ---------------------------------------------------------------------------------------


@EACH
def test_design_round_trips_through_json(design: KinematicDesign) -> None:
    assert KinematicDesign.from_json(design.to_json()) == design
    assert hash(design) == hash(replace(design))


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"format": "other"}, "format"),
        ({"dt_s": [1.0, 0.5]}, "ascend"),
        ({"dt_s": None}, "not a kinematic design"),
        ({"surplus": 1}, "not a kinematic design"),
        ({"acceleration_mps2": "fast"}, "not a kinematic design"),
        ({"acceleration_mps2": -1.0}, "negative bound"),
        ({"acceleration_mps2": 1e300}, "beyond 1e\\+30"),
        ({"dt_s": [1e200 * dt for dt in WITH_VELOCITY.dt_s]}, "beyond 1e\\+30"),
        ({"dt_s": [1e-200 * dt for dt in WITH_VELOCITY.dt_s]}, "beyond 1e\\+30"),
        ({"acceleration_mps2": 10**400}, "not a kinematic design"),
        ({"acceleration_mps2": math.nan}, "finite"),
        ({"velocity_noise_mps": None}, "do not match its grid"),
        ({"lyapunov": [1.0, 2.0, 1.0]}, "positive definite"),
        ({"lyapunov": [1.0, 2.0]}, "do not match its grid"),
        ({"corrections": [[1.0]]}, "do not match its grid"),
        ({"acceleration_mps2": 50.0}, "certificate"),
    ],
)
def test_malformed_design_json_is_rejected_in_one_line(
    change: dict[str, object], fault: str
) -> None:
    text = json.dumps({**json.loads(WITH_VELOCITY.to_json()), **change})
    with pytest.raises(DesignError, match=fault) as raised:
        KinematicDesign.from_json(text)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "text",
    [
        *("", "[]", "{", "3", '{"format": "kinematic-design-1"}'),
        *("[" * 100_000, '{"a":' * 100_000, "9" * 6000, " " * (1 << 20) + "{}"),
    ],
    ids=range(9),
)
def test_invalid_design_is_rejected(text: str) -> None:
    with pytest.raises(DesignError):
        KinematicDesign.from_json(text)


# --- command ------------------------------------------------------------------------------------


def run(*arguments: str) -> Result:
    return CliRunner().invoke(main, ["design", "--model", "kinematic", *arguments])


@pytest.mark.full
def test_design_command_designs_each_interval_separately() -> None:
    rows = json.loads(run("--dt", "0.1,1", "--mu-max", "4", "--json").stdout)
    assert [row["dt_s"] for row in rows] == [0.1, 1.0]
    for row, feasible in zip(rows, (True, False), strict=True):
        assert set(row) == {
            *("dt_s", "model", "alpha", "feedthrough_s", "L", "Q", "mu", "gamma"),
            *("peak_gain", "feasible", "dt_limit_s", "method", "residual"),
        }
        assert (row["model"], row["method"]) == ("kinematic", "lmi")
        a = np.array([[1, row["dt_s"]], [0, 1]])
        assert np.array(row["Q"]) + row["L"] == pytest.approx(a)
        assert row["gamma"] == pytest.approx(math.sqrt(row["mu"]))
        deadbeat_m = 0.5 + 0.2 * row["dt_s"] + 2.5 * row["dt_s"] ** 2
        assert deadbeat_m * 0.999 <= row["peak_gain"] <= row["gamma"] <= 1.16 * deadbeat_m
        assert row["residual"] > -1e-6
        assert row["feasible"] is feasible
    limit_s = rows[0]["dt_limit_s"]
    motion = answers.KinematicLimits(5.0, 0.5, 0.2)
    assert answers.kinematic_row(limit_s, motion)["mu"] <= 4
    assert answers.kinematic_row(1.003 * limit_s, motion)["mu"] > 4


def test_design_command_without_velocity() -> None:
    (row,) = json.loads(run("--dt", "0.25", "--no-velocity", "--json").stdout)
    assert np.shape(row["L"]) == (2, 1)
    assert row["peak_gain"] <= row["gamma"] == pytest.approx(1.73, rel=0.01)
    (fixed,) = json.loads(run("--dt", "0.25", "--no-velocity", "--alpha", "0.3", "--json").stdout)
    assert fixed["alpha"] == pytest.approx(0.3)
    assert fixed["gamma"] > row["gamma"]
    text = run("--dt", "0.25", "--no-velocity").stdout
    assert "gamma 1.7" in text
    assert "L [1.5" in text


@pytest.mark.full
def test_design_command_writes_a_table(tmp_path: Path) -> None:
    out = tmp_path / "table.json"
    bounds = ("--acceleration", "8", "--position-noise", "1", "--velocity-noise", "0.4")
    done = run("--dt-range", "0.1,0.4", *bounds, "--out", str(out))
    assert (done.exit_code, done.stdout) == (0, "")
    assert "24 intervals from 0.1 to 0.4 s" in done.stderr
    design = KinematicDesign.from_json(out.read_text(encoding="utf-8"))
    assert (design.dt_s[0], design.dt_s[-1]) == pytest.approx((0.1, 0.4))
    assert (design.acceleration_mps2, design.velocity_noise_mps) == (8.0, 0.4)
    assert design.provenance.startswith("companion design --model kinematic --acceleration 8 ")
    alone = answers.kinematic_row(0.4, answers.KinematicLimits(8.0, 1.0, 0.4))["gamma"]
    assert alone <= gain_table.invariant_bound(design) < 1.1 * alone


@pytest.mark.full
def test_table_bound_without_velocity_is_near_that_of_the_longest_interval() -> None:
    """One alpha per interval; a common alpha gives 6.1 m here, the longest interval alone 3.3 m."""
    motion = answers.KinematicLimits(5.0, 0.5, None)
    design = answers.table((0.05, 0.5), motion, points=12)
    alone_m = answers.kinematic_row(0.5, motion)["gamma"]
    assert alone_m <= gain_table.invariant_bound(design) <= 1.07 * alone_m


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        ([], "give --dt, or --out"),
        (["--dt", "-1"], "positive number of seconds"),
        (["--dt", "0.1", "--acceleration", "0"], "positive numbers"),
        (["--dt", "0.1", "--velocity-noise", "nan"], "positive numbers"),
        (["--dt", "0.1", "--method", "closed-form"], "supports neither closed-form"),
        (["--dt", "0.1", "--feedthrough", "0.5"], "nor --feedthrough"),
        (["--dt", "0.1", "--alpha", "1"], "alpha is 1.0, allowed: 0 to 1, both excluded"),
        (["--dt-range", "2,1", "--out", "x"], "give LOW,HIGH, positive and ascending"),
        (["--dt-range", "2", "--out", "x"], "give LOW,HIGH, positive and ascending"),
        (["--alpha", "0.5", "--out", "x"], "searches alpha itself"),
        (["--dt", "0.1", "--out", "/nowhere/x", "--dt-range", "0.1,0.2"], "/nowhere/x"),
        (["--model", "position", "--out", "x"], "only with --model kinematic"),
    ],
)
def test_command_error_is_one_line(arguments: list[str], fault: str) -> None:
    done = run(*arguments)
    assert done.exit_code != 0
    assert fault in done.stderr
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
