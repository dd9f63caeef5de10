"""Draws the import graph of companion/ as docs/architecture.svg, from the code's own imports.

    python docs/draw_architecture.py            # draws it anew
    python docs/draw_architecture.py --check    # fails where it is not up to date

Rooms are the folders of ``companion/``; a room stands above all that it imports. An arrow from a
room to another says that it imports it, numbers on the rooms are modules and lines. Arrows that
others imply (a imports b, b imports c, and a imports c as well) are left out.
"""

import ast
import sys
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PICTURE = ROOT / "docs" / "architecture.svg"
PACKAGES = ("companion", "sitl_replay")
BOX = (190, 58)
GAP = (36, 46)


def room_of(module: str) -> str | None:
    """The room of a module: a folder of ``companion``, or ``sitl_replay``; None for loose ones."""
    parts = module.split(".")
    if parts[0] == "sitl_replay":
        return "sitl_replay"
    if parts[0] != "companion" or len(parts) < 2:
        return None
    return parts[1] if (ROOT / "companion" / parts[1]).is_dir() else None


def imports(path: Path) -> set[str]:
    """Full names of what a file imports, inside functions and under TYPE_CHECKING too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{name.name}" for name in node.names}
    return found


def rooms() -> tuple[dict[str, tuple[int, int]], dict[str, set[str]]]:
    """Modules and lines of each room, and which rooms each imports."""
    sizes: dict[str, tuple[int, int]] = {}
    edges: dict[str, set[str]] = defaultdict(set)
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            room = room_of(module)
            if room is None:
                continue
            modules, lines = sizes.get(room, (0, 0))
            counts = path.name != "__init__.py"
            text = path.read_text(encoding="utf-8")
            sizes[room] = modules + counts, lines + text.count("\n")
            edges[room] |= {to for name in imports(path) if (to := room_of(name))} - {room}
    return sizes, edges


def floors(sizes: dict[str, tuple[int, int]], edges: dict[str, set[str]]) -> dict[str, int]:
    """How far above the ground each room stands. ``SystemExit`` where rooms import in a circle.

    The one arrow that is left out of this: the demo, a part of ``node``, flies ``sitl_replay``.
    """
    below = {room: edges[room] - ({"sitl_replay"} if room == "node" else set()) for room in sizes}
    found: dict[str, int] = {}
    while len(found) < len(sizes):
        ready = [r for r in sizes if r not in found and below[r] <= found.keys()]
        if not ready:
            raise SystemExit(f"rooms in a circle: {sorted(sizes.keys() - found.keys())}")
        found |= {r: 1 + max((found[x] for x in below[r]), default=-1) for r in ready}
    return found


def implied(edges: dict[str, set[str]], room: str, to: str) -> bool:
    """Whether a room comes to another by way of a third that it imports."""

    def reaches(start: str, seen: set[str]) -> bool:
        if start == to:
            return True
        onward = edges[start] - seen - {room}
        return any(reaches(x, seen | {start}) for x in onward)

    return any(reaches(other, {room}) for other in edges[room] - {to})


def drawn() -> str:
    """The picture as SVG."""
    sizes, edges = rooms()
    floor = floors(sizes, edges)
    rows = [sorted(r for r in floor if floor[r] == at) for at in range(max(floor.values()) + 1)]
    width = max(len(row) for row in rows) * (BOX[0] + GAP[0]) + GAP[0]
    height = len(rows) * (BOX[1] + GAP[1]) + GAP[1]
    at: dict[str, tuple[float, float]] = {}
    for level, row in enumerate(rows):
        left = (width - len(row) * (BOX[0] + GAP[0]) + GAP[0]) / 2
        for place, room in enumerate(row):
            y = height - (level + 1) * (BOX[1] + GAP[1])
            at[room] = left + place * (BOX[0] + GAP[0]), y
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        'font-family="sans-serif" font-size="13">',
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" '
        'markerHeight="7" orient="auto"><path d="M0 0 8 4 0 8z" fill="#6b7a8f"/></marker></defs>',
    ]
    edges["node"].discard("sitl_replay")  # the demo, which the text tells of
    for room in sorted(edges):
        kept = sorted(to for to in edges[room] if not implied(edges, room, to))
        kept.sort(key=lambda to: at[to][0])
        for number, to in enumerate(kept):
            x0 = at[room][0] + BOX[0] * (number + 1) / (len(kept) + 1)
            y0 = at[room][1] + BOX[1]
            x1, y1 = at[to][0] + BOX[0] / 2, at[to][1]
            bend = (y1 - y0) / 2
            lines.append(
                f'<path d="M{x0:.0f} {y0:.0f}C{x0:.0f} {y0 + bend:.0f} {x1:.0f} {y1 - bend:.0f} '
                f'{x1:.0f} {y1:.0f}" fill="none" stroke="#6b7a8f" opacity=".55" '
                'marker-end="url(#tip)"/>'
            )
    for room, (x, y) in sorted(at.items()):
        modules, count = sizes[room]
        lines.append(
            f'<rect x="{x:.0f}" y="{y:.0f}" width="{BOX[0]}" height="{BOX[1]}" rx="6" '
            'fill="#f3f6fa" stroke="#2b4a6f"/>'
            f'<text x="{x + BOX[0] / 2:.0f}" y="{y + 25:.0f}" text-anchor="middle" '
            f'font-weight="bold" fill="#16283c">{room}</text>'
            f'<text x="{x + BOX[0] / 2:.0f}" y="{y + 44:.0f}" text-anchor="middle" '
            f'fill="#4a5a6c">{modules} modules, {count} lines</text>'
        )
    return "\n".join([*lines, "</svg>"]) + "\n"


def main() -> None:
    """Draw, or check. The numbers of lines may differ: a check compares rooms and arrows."""
    made = drawn()
    if "--check" not in sys.argv[1:]:
        PICTURE.write_text(made, encoding="utf-8")
        return

    def arrows(text: str) -> list[str]:
        return [line for line in text.splitlines() if line.startswith("<path d")] + [
            line.partition(">")[0] for line in text.splitlines() if line.startswith("<rect x")
        ]

    there = PICTURE.read_text(encoding="utf-8") if PICTURE.exists() else ""
    if arrows(there) != arrows(made):
        raise SystemExit("docs/architecture.svg is out of date: python docs/draw_architecture.py")


if __name__ == "__main__":
    main()
