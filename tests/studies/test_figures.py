"""Figures: lines that can be told apart, files that are the same again, words that are safe."""

from itertools import pairwise

import matplotlib
from matplotlib.figure import Figure

from companion.studies import figures


def drawn() -> Figure:
    figure, (axes,) = figures.new(1, 1, (3.0, 2.0))
    axes.plot([0, 1], [1, 0], label="falling", **figures.marked(0))
    figures.below(figure, axes, 1)
    return figure


def test_36_lines_differ_in_colour_or_dash_and_neighbours_in_both() -> None:
    looks = [(each["color"], each["linestyle"]) for each in map(figures.line, range(36))]
    assert len(set(looks)) == 36
    for one, next_one in pairwise(looks[:6]):
        assert one[0] != next_one[0] and one[1] != next_one[1]


def test_a_figure_is_the_same_again_and_leaves_the_style_as_it_was() -> None:
    before = dict(matplotlib.rcParams)
    svg, png = figures.rendered(drawn)
    assert (svg, png) == figures.rendered(drawn)
    assert b"<svg" in svg and png.startswith(b"\x89PNG")
    assert dict(matplotlib.rcParams) == before


def test_files_are_the_page_and_each_figure_twice() -> None:
    said: list[str] = []
    made = figures.files("all", {"one": ("a < b", drawn)}, lambda shown: shown["one"], said.append)
    assert made.keys() == {"one.svg", "one.png", "all.html"}
    assert made["all.html"].decode() == figures.inline(made["one.png"], "one", "a < b")
    assert said == ["drawing one"]


def test_a_caption_cannot_leave_its_place() -> None:
    html = figures.inline(b"", 'x"y', '"><script>')
    assert "<script>" not in html and '""' not in html and 'x"y' not in html
    assert html.count("&quot;&gt;&lt;script&gt;") == 2
