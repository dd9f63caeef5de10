"""The cases of the compass study, and their results."""

from dataclasses import dataclass
from itertools import chain
from typing import Any, Final

from companion.studies.compass import flight
from companion.studies.compass.flight import ARRAY, KALMAN, METHODS, Case
from companion.studies.compass.receiver import RECEIVERS, ArrayReceiver
from companion.studies.figures.text_tables import decimal, text_table
from companion.studies.origin import Progress, Row, StudiedLogs, by_log, versions
from companion.studies.running import fan_out
from companion.values import UserError

USUAL: Final = RECEIVERS[1]
MOUNT_DEG: Final = 2.0
MOUNTS_DEG: Final = (0.0, MOUNT_DEG, 5.0)
FEW: Final = (1, 2)  # UAVs that are measured, besides all

HEAD: Final = (
    "receiver, error of the mount, UAVs: method",
    "bound, deg",
    "error 95 %, deg",
    "beyond",
    "guaranteed, dB",
    "true gain, dB",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class CompassStudy(StudiedLogs):
    """Parameters of the compass study.

    seconds  part of each flight that is studied
    jobs     processes that run at once

    Raises ``UserError`` for a time out of range.
    """

    seconds: float = 60.0
    seed: int = 0
    jobs: int = 1

    def __post_init__(self) -> None:
        if not 15 <= self.seconds <= 3600:
            raise UserError(f"--seconds {self.seconds:g}: give 15 to 3600 seconds of flight")

    def cases(self) -> list[Case]:
        """Return all cases: one thing varies at a time about the usual case."""
        variants: list[tuple[ArrayReceiver, float, int | None]] = [
            (USUAL, MOUNT_DEG, None),
            *((one, MOUNT_DEG, None) for one in RECEIVERS if one is not USUAL),
            *((USUAL, mount, None) for mount in MOUNTS_DEG if mount != MOUNT_DEG),
            *((USUAL, MOUNT_DEG, few) for few in FEW),
        ]
        return [
            Case(
                logs=logs,
                settings=settings,
                receiver=receiver,
                mount_deg=mount,
                uavs=uavs,
                seconds=self.seconds,
                seed=self.seed,
            )
            for logs, settings in self.by_flight()
            for receiver, mount, uavs in variants
        ]


def study(asked: CompassStudy, progress: Progress) -> dict[str, Any]:
    """Return the answer as written to ``compass.json``.

    Raises ``UserError`` for a flight without the truth of its carrier.
    """
    cases = asked.cases()

    def show(done: int) -> None:
        progress(f"{done} of {len(cases)} cases")

    rows: list[Row] = list(chain(*fan_out.on_cores(flight.run, cases, asked.jobs, show)))
    return {
        "command": asked.command_line("compass", seconds=asked.seconds, seed=asked.seed),
        "seconds": asked.seconds,
        "seed": asked.seed,
        "methods": list(METHODS),
        "rows": rows,
        "versions": versions(),
    }


def cells(row: Row) -> tuple[str, ...]:
    """Return a row as the cells of a table, in the order of ``HEAD``."""
    uavs = f"{row['uavs']} UAV{'s' if row['uavs'] > 1 else ''}"
    label = f"{row['receiver']}, {row['mount_deg']:g} degrees, {uavs}: {row['method']}"
    beyond = f"{row['beyond']}"
    if row["method"] == KALMAN and row["beyond_share"] is not None:
        beyond = f"{row['beyond_share']:.1%}"
    return (
        label,
        decimal(row["pointing_bound_median_deg"]),
        decimal(row["pointing_error_p95_deg"]),
        beyond,
        decimal(row["guaranteed_gain_median_db"]),
        decimal(row["true_gain_median_db"]),
    )


def text(answer: dict[str, Any]) -> str:
    """Return the tables of the study as text, one for each flight."""
    parts = [
        f"{log}\n{text_table([HEAD, *map(cells, rows)])}"
        for log, rows in by_log(answer["rows"]).items()
    ]
    known = [row for row in answer["rows"] if row["method"] == ARRAY and row["refuted"]]
    parts += [f"{row['log']}: positions refuted of {', '.join(row['refuted'])}" for row in known]
    return "\n\n".join(parts)
