"""SVG drawings of lines and labels: x to the right and y down from the upper left corner."""

from dataclasses import dataclass
from html import escape
from typing import Final, Literal

from companion.values import FloatArray

Anchor = Literal["start", "middle", "end"]
INK: Final = "#111111"


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Line:
    """Polyline of a drawing through points (N, 2).

    ``colour`` is #rrggbb; ``dash`` alternates drawn and blank lengths, empty for a solid line.
    """

    points: FloatArray
    colour: str = INK
    width: float = 1.0
    dash: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class TextLabel:
    """Text of a drawing; its baseline starts, is centred or ends at x, y, by ``anchor``."""

    x: float
    y: float
    text: str
    anchor: Anchor = "start"
    size: float = 12.0
    colour: str = INK


@dataclass(frozen=True, slots=True, kw_only=True)
class Drawing:
    """Lines with labels on top, on white; ``title`` is for screen readers."""

    width: int
    height: int
    title: str
    lines: tuple[Line, ...]
    words: tuple[TextLabel, ...]


def svg(drawing: Drawing) -> str:
    """Return a drawing as an SVG document, which HTML may embed."""
    size = f'viewBox="0 0 {drawing.width} {drawing.height}" width="{drawing.width}"'
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img"'
        ' font-family="system-ui, sans-serif">',
        f"<title>{escape(drawing.title)}</title>",
        f'<path d="M0 0H{drawing.width}V{drawing.height}H0z" fill="#ffffff"/>',
    ]
    for line in drawing.lines:
        places = " ".join(f"{x:.1f},{y:.1f}" for x, y in line.points.tolist())
        dash = " ".join(f"{length:g}" for length in line.dash)
        parts.append(
            f'<polyline points="{places}" fill="none" stroke="{line.colour}"'
            f' stroke-width="{line.width:g}" stroke-linejoin="round"'
            + (f' stroke-dasharray="{dash}"/>' if dash else "/>")
        )
    for word in drawing.words:
        parts.append(
            f'<text x="{word.x:.1f}" y="{word.y:.1f}" font-size="{word.size:g}"'
            f' text-anchor="{word.anchor}" fill="{word.colour}">{escape(word.text)}</text>'
        )
    return "\n".join([*parts, "</svg>"])
