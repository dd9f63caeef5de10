"""The table of an endurance run, printed at its end and kept as JSON."""

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

TABLE = Path(os.environ.get("SOAK_JSON", "build/soak.json"))
"""Where the table is kept; rows of tests that were not run are left as they are."""


class Table:
    """What was measured: rows of name, number, unit and what is asked of it."""

    def __init__(self) -> None:
        self.rows: dict[str, dict[str, Any]] = {}

    def add(self, name: str, value: float, unit: str, asked: str) -> None:
        self.rows[name] = {"value": round(value, 3), "unit": unit, "asked": asked}


@pytest.fixture(scope="session")
def table() -> Iterator[Table]:
    """Rows are added by the tests."""
    made = Table()
    yield made
    kept = json.loads(TABLE.read_text()) if TABLE.exists() else {}
    TABLE.parent.mkdir(parents=True, exist_ok=True)
    TABLE.write_text(json.dumps(kept | made.rows, indent=2) + "\n")
    print()
    for name, row in made.rows.items():
        print(f"| {name} | {row['value']:g} {row['unit']} | {row['asked']} |")
