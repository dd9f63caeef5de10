"""Mount of an array as a flight with observations suggests it."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from companion.node.replay import log_events
from companion.pipeline.fold import Pipeline
from companion.settings.model import Settings
from companion.tracking.rotations import rotation
from companion.values import FloatArray, Tick, UserError, roll_pitch_yaw_rad

SEPARATE: Final = 0.1
"""Least ratio of eigenvalues at which the parts of mount and compass are told apart."""
PROGRESS_EVERY: Final = 500  # ticks between two progress messages


def suggest(
    logs: Sequence[Path], settings: Settings, progress: Callable[[str], None]
) -> dict[str, Any]:
    """Return the suggested mount, its change and its bound, in degrees.

    The error of the attitude is the sum of a part fixed in the body, the mount's, and one fixed in
    the local frame, the compass's; least squares over the flight. Raises ``UserError`` for a flight
    without observations.
    """
    pipeline = Pipeline(settings)
    normal, total, whole = np.zeros((6, 6)), np.zeros(6), np.zeros(3)
    bounds: list[float] = []
    for event in log_events(logs, settings):
        pipeline.step(event)
        error, update = pipeline.observing.compass.error, pipeline.last_update
        if not isinstance(event, Tick) or error is None or update is None:
            continue
        reported = pipeline.observing.reported(event.t_ns, event.t_ns)
        if isinstance(reported, str):
            continue
        body_from_local = reported.carrier.body_from_local
        seen = body_from_local @ pipeline.observing.uavs.likely.vector_rad(body_from_local)
        rows = np.hstack([np.eye(3), body_from_local])
        normal += rows.T @ rows
        total += rows.T @ seen
        whole += seen
        bounds.append(error.bound_rad)
        if len(bounds) % PROGRESS_EVERY == 0:
            progress(f"{len(bounds)} updates with observations")
    if not bounds:
        raise UserError(
            f"{logs[0]}: no observations of UAVs; record a flight with `[observations] enabled ="
            " true`"
        )
    values = np.linalg.eigvalsh(normal)
    is_separate = bool(values[0] > SEPARATE * values[-1])
    parts: FloatArray = np.concatenate([whole / len(bounds), np.zeros(3)])
    if is_separate:
        parts = np.asarray(np.linalg.solve(normal, total), dtype=np.float64)
    before = pipeline.array.array_from_body
    after = before @ rotation(parts[:3])
    return {
        "updates": len(bounds),
        "mount_deg": dict(zip(_NAMES, np.degrees(roll_pitch_yaw_rad(after)).tolist(), strict=True)),
        "change_deg": math.degrees(float(np.linalg.norm(parts[:3]))),
        "compass_deg": math.degrees(float(np.linalg.norm(parts[3:]))) if is_separate else None,
        "bound_deg": math.degrees(float(np.median(bounds))),
        "separate": is_separate,
    }


_NAMES: Final = ("roll", "pitch", "yaw")


def text(found: dict[str, Any]) -> str:
    """Return the suggestion as lines for a person, to be copied into the settings."""
    mount = found["mount_deg"]
    change = f"{found['change_deg']:.2f} degrees"
    if found["separate"]:
        parts = f"mount: {change} from the settings; compass: {found['compass_deg']:.2f} degrees"
    else:
        parts = (
            f"mount and compass together: {change}; the carrier hardly turned, so fly with headings"
            " of all directions to tell them apart"
        )
    return "\n".join(
        (
            f"{found['updates']} updates with observations; the error of the attitude is known"
            f" within {found['bound_deg']:.2f} degrees (median)",
            parts,
            "[array]",
            *(f"mount_{name}_deg = {mount[name]:.2f}" for name in _NAMES),
        )
    )
