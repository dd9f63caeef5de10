"""Run docs/researcher.ipynb, and write docs/researcher.md with what its cells show.

    python docs/make_researcher.py [--check]

With --check nothing is written: the cells are run, and status 1 says that the page shows others.
The notebook itself is kept without output, so that its changes can be read.
"""

import contextlib
import io
import json
import os
import sys
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl

mpl.use("Agg")
from matplotlib import pyplot as plt

DOCS: Final = Path(__file__).resolve().parent
NOTEBOOK: Final = DOCS / "researcher.ipynb"
PAGE: Final = DOCS / "researcher.md"


def run(code: str, names: dict[str, Any]) -> str:
    """What a cell prints. Figures stay open."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        exec(compile(code, str(NOTEBOOK), "exec"), names)
    return said.getvalue()


def page(cells: list[dict[str, Any]], *, writes: bool) -> str:
    """The page in Markdown; its pictures are written beside it."""
    names: dict[str, Any] = {"__name__": "__main__"}
    parts, pictures = list[str](), 0
    for cell in cells:
        text = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(text)
            continue
        parts.append(f"```python\n{text}\n```")
        if said := run(text, names):
            parts.append(f"```text\n{said.rstrip()}\n```")
        for number in plt.get_fignums():
            pictures += 1
            name = f"researcher-{pictures}.png"
            if writes:
                plt.figure(number).savefig(DOCS / name, dpi=110, bbox_inches="tight")
            parts.append(f"![What the cell above draws]({name})")
            plt.close(number)
    return "\n\n".join(parts) + "\n"


def blocks(text: str, language: str) -> list[str]:
    """Fenced blocks of one language."""
    return [part.split("\n```")[0] for part in text.split(f"```{language}\n")[1:]]


def main() -> None:
    """Write the page, or check that its code is the notebook's and still runs."""
    os.chdir(DOCS.parent)
    check = "--check" in sys.argv[1:]
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    made = page(cells, writes=not check)
    if not check:
        PAGE.write_text(made, encoding="utf-8")
    elif blocks(PAGE.read_text(encoding="utf-8"), "python") != blocks(made, "python"):
        sys.exit(f"{PAGE.name} is not up to date: python docs/make_researcher.py")


if __name__ == "__main__":
    main()
