"""Figures: distinguishable lines, reproducible files, escaped text."""

from base64 import b64encode
from itertools import pairwise

import matplotlib
from matplotlib.figure import Figure

from companion.studies.figures import pages, plotting

ANSWER = {"command": "companion study", "versions": {"numpy": "2"}}


def drawn() -> Figure:
    figure, (axes,) = plotting.new(1, 1, (3.0, 2.0))
    axes.plot([0, 1], [1, 0], label="falling", **plotting.marked(0))
    plotting.below(figure, axes, 1)
    return figure


def test_36_lines_differ_in_colour_or_dash_and_neighbours_in_both() -> None:
    looks = [(each["color"], each["linestyle"]) for each in map(plotting.line, range(36))]
    assert len(set(looks)) == 36
    for one, next_one in pairwise(looks[:6]):
        assert one[0] != next_one[0] and one[1] != next_one[1]


def test_figure_is_reproducible_and_restores_the_style() -> None:
    before = dict(matplotlib.rcParams)
    svg, png = plotting.render_figure(drawn)
    assert (svg, png) == plotting.render_figure(drawn)
    assert b"<svg" in svg and png.startswith(b"\x89PNG")
    assert dict(matplotlib.rcParams) == before


def test_files_are_the_page_and_each_figure_as_svg_and_png() -> None:
    said: list[str] = []
    values = {"answer": ANSWER}
    drawings = {"one": ("a < b", drawn)}
    made = plotting.files("all", "figures/page.html.j2", drawings, values, said.append)
    assert made.keys() == {"one.svg", "one.png", "all.html"}
    data = b64encode(made["one.png"]).decode()
    shown = {"name": "one", "caption": "a < b", "png_base64": data}
    page = pages.page("figures/page.html.j2", answer=ANSWER, figures={"one": shown})
    assert made["all.html"].decode() == page
    assert f"data:image/png;base64,{data}" in page
    assert said == ["drawing one"]
