"""Drawings: what an SVG holds."""

from xml.etree import ElementTree

import numpy as np

from companion.studies.figures.drawing import Drawing, Line, Words, svg


def test_svg_says_what_is_drawn() -> None:
    words = (Words(30, 20, "a < b & c", "end", 11.0, "#555555"),)
    text = svg(
        Drawing(60, 40, "x > y", (Line(np.array([[1.0, 2.0], [3.0, 4.25]]), dash=(6, 3)),), words)
    )
    root = ElementTree.fromstring(text)
    polyline, said = root.find("{*}polyline"), root.find("{*}text")
    assert polyline is not None
    assert said is not None
    assert polyline.attrib["points"] == "1.0,2.0 3.0,4.2"
    assert polyline.attrib["stroke-dasharray"] == "6 3"
    assert said.text == "a < b & c"
    assert said.attrib["text-anchor"] == "end"
    assert root.findtext("{*}title") == "x > y"
