"""Write the tables of docs/export.md, the reference of the exports, from their columns.

    python docs/make_export.py [--check]

With --check nothing is written; status 1 says that the page is not up to date.
"""

import re
import sys
from pathlib import Path
from typing import Final

from companion.recording.tables.columns import Table
from companion.views.tables.said import TABLES

PAGE: Final = Path(__file__).resolve().parent / "export.md"


def section(table: Table) -> str:
    """The section of one table in Markdown."""
    rows = [f"| `{one.name}` | {one.kind} | {one.unit} | {one.meaning} |" for one in table.columns]
    head = f"## {table.name}\n\nA row is {table.row_is}.\n\n| column | type | unit | meaning |"
    return "\n".join([head, "|---|---|---|---|", *rows, ""])


def page(text: str) -> str:
    """The page with the sections of all tables as they are now; the rest stays."""
    for table in TABLES:
        pattern = rf"^## {table.name}\n.*?(?=^## |\Z)"
        text = re.sub(
            pattern, lambda _, table=table: section(table) + "\n", text, flags=re.M | re.S
        )
    return text.rstrip() + "\n"


def main() -> None:
    """Write the page, or check it."""
    before = PAGE.read_text(encoding="utf-8")
    after = page(before)
    if "--check" not in sys.argv[1:]:
        PAGE.write_text(after, encoding="utf-8")
    elif before != after:
        sys.exit(f"{PAGE.name} is not up to date: python docs/make_export.py")


if __name__ == "__main__":
    main()
