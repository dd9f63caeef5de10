"""Times and angles as they are written at the edge of the program."""

from datetime import UTC, datetime

import numpy as np


def rfc3339(t_ns: int) -> str:
    """A time in UTC with milliseconds: 2026-11-20T13:00:00.123Z."""
    seconds, milliseconds = divmod(t_ns // 1_000_000, 1000)
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S}.{milliseconds:03d}Z"


def degrees(angle_rad: float | None) -> float | None:
    """Radians to degrees; None stays null."""
    return None if angle_rad is None else float(np.degrees(angle_rad))
