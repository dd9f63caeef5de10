"""Write the references of exports and recordings, from the described values of their rows.

    python docs/make_export.py [--check]

These are the tables of docs/export.md and the section "Fields" of docs/recording.md; the rest of
both pages stays. With --check nothing is written; status 1 says that a page is not up to date.
"""

import re
import sys
from pathlib import Path
from typing import Final

from companion.recording import fields
from companion.recording.tables.columns import Table
from companion.views.tables.said import TABLES

DOCS: Final = Path(__file__).resolve().parent
NOT_RECORDED: Final = ("Offer",)
"""Messages that nodes of a fleet send one another (docs/fleet.md)."""


def table_section(table: Table) -> str:
    """The section of one exported table in Markdown."""
    rows = [f"| `{one.name}` | {one.kind} | {one.unit} | {one.meaning} |" for one in table.columns]
    head = f"## {table.name}\n\nA row is {table.row_is}.\n\n| column | type | unit | meaning |"
    return "\n".join([head, "|---|---|---|---|", *rows, ""])


def fields_section() -> str:
    """The section of the fields of all recorded messages in Markdown."""
    parts = [
        "## Fields\n\nFields of this program's own messages, by number."
        " An unknown vector is empty.\n"
    ]
    for name in fields.CLASSES:
        if name in NOT_RECORDED:
            continue
        parts.append(
            f"\n### companion.{name}\n\n| number | field | type | meaning |\n|---|---|---|---|\n"
        )
        for one in fields.fields(name):
            kind = one.declared.rpartition(" ")[0]
            parts.append(f"| {one.number} | `{one.name}` | {kind} | {one.meaning} |\n")
    return "".join(parts)


def put(text: str, title: str, section: str) -> str:
    """A page with one section replaced."""
    found = re.search(rf"^## {title}\n.*?(?=^## |\Z)", text, re.MULTILINE | re.DOTALL)
    assert found is not None, title
    return (text[: found.start()] + section + "\n" + text[found.end() :]).rstrip() + "\n"


def main() -> None:
    """Write the pages, or check them."""
    pages = {
        name: (DOCS / name).read_text(encoding="utf-8") for name in ("export.md", "recording.md")
    }
    made = {**pages, "recording.md": put(pages["recording.md"], "Fields", fields_section())}
    for table in TABLES:
        made["export.md"] = put(made["export.md"], table.name, table_section(table))
    for name, text in made.items():
        if "--check" not in sys.argv[1:]:
            (DOCS / name).write_text(text, encoding="utf-8")
        elif text != pages[name]:
            sys.exit(f"{name} is not up to date: python docs/make_export.py")


if __name__ == "__main__":
    main()
