"""Drawings: contents of an SVG."""

from xml.etree import ElementTree

import numpy as np

from companion.studies.figures.drawing import Drawing, Line, TextLabel, svg


def test_svg_holds_the_drawn_elements() -> None:
    words = (TextLabel(x=30, y=20, text="a < b & c", anchor="end", size=11.0, colour="#555555"),)
    text = svg(
        Drawing(
            width=60,
            height=40,
            title="x > y",
            lines=(Line(points=np.array([[1.0, 2.0], [3.0, 4.25]]), dash=(6, 3)),),
            words=words,
        )
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
