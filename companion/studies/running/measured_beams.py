"""Reader of DeepSense 6G tables: a position and the best beam for each sample.

A scenario is a CSV file, or a folder with one. Positions are in the table (``unit2_pos``, two
numbers in brackets) or in small text files that it names (``unit2_loc``), received powers per beam
in files that it names (``unit1_pwr_60ghz``). https://www.deepsense6g.net/scenarios/. The data
are for research (CC BY-NC-SA 4.0) and not part of this program.
"""

import csv
import math
import re
from collections.abc import Mapping
from io import TextIOWrapper
from pathlib import Path
from typing import Final

import numpy as np

from companion.mavlink.links.regular_file import open_regular
from companion.studies.deepsense.samples import Samples
from companion.values import UserError

_PLACES: Final = ("unit2_pos", "unit2_loc_cal", "unit2_loc")
_BEAMS: Final = ("unit1_beam", "unit1_beam_index", "beam_index")
_POWERS: Final = ("unit1_pwr_60ghz", "unit1_pwr")
_BEAMS_MAX: Final = 1024
_numbers = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?").findall


def read(where: Path) -> Samples:
    """Return the samples of a scenario, in the order of measurement.

    Raises ``UserError`` for an invalid folder or table.
    """
    table = _table(where)
    places: list[list[float]] = []
    beams: list[int] = []
    powers: list[list[float]] = []
    try:
        with TextIOWrapper(open_regular(table), "utf-8-sig", newline="") as file:
            rows = csv.DictReader(file)
            place, beam, power = (
                next((name for name in names if name in (rows.fieldnames or ())), None)
                for names in (_PLACES, _BEAMS, _POWERS)
            )
            if place is None or beam is None:
                raise UserError(f"{table}: columns {_PLACES[0]} and {_BEAMS[0]} are missing")
            for row in rows:
                places.append(_values(row, place, table.parent)[:2])
                beams.append(int(float(row[beam])))
                if power is not None:
                    powers.append(_values(row, power, table.parent))
    except OSError as error:
        raise UserError(f"{error.filename or table}: cannot read: {error.strerror}") from None
    except (ValueError, KeyError, TypeError, csv.Error) as error:
        raise UserError(f"{table}: row {len(beams) + 2}: {error}") from None
    return _checked(table, places, beams, powers)


def _table(where: Path) -> Path:
    if not where.is_dir():
        return where
    found = sorted(where.glob("*.csv"))
    if len(found) != 1:
        raise UserError(f"{where}: folder has {len(found)} CSV files; name one of them")
    return found[0]


def _values(row: Mapping[str, str], column: str, folder: Path) -> list[float]:
    """Return the numbers in a cell, or in the text file that it names."""
    cell = row[column].strip()
    if cell.endswith(".txt"):
        with open_regular(folder / cell) as file:
            cell = file.read().decode()
    return [float(number) for number in _numbers(cell)]


def _checked(
    table: Path, places: list[list[float]], beams: list[int], powers: list[list[float]]
) -> Samples:
    if len(beams) < 200 or any(len(place) != 2 for place in places):
        raise UserError(f"{table}: give at least 200 rows with two coordinates each")
    if min(beams) < 0 or max(beams) >= _BEAMS_MAX:
        raise UserError(f"{table}: beam index out of range, allowed: 0 or 1 to {_BEAMS_MAX}")
    place = np.array(places)
    if not np.isfinite(place).all():
        raise UserError(f"{table}: a coordinate is not finite")
    spread = np.ptp(place, axis=0)
    if not (spread > 0).all():
        raise UserError(f"{table}: positions do not change")
    best = np.array(beams)
    count = 2 ** math.ceil(math.log2(max(2, int(best.max() - (best.min() > 0)) + 1)))
    if len({len(power) for power in powers}) > 1:
        raise UserError(f"{table}: rows have different numbers of measured beams")
    measured = np.array(powers) if powers and len(powers[0]) >= best.max() else None
    return Samples(
        name=table.name,
        place=(place - place.min(axis=0)) / spread,
        beam=best,
        beams=count,
        power=measured,
    )
