"""The report pages of all studies in a real browser, from the file system, without a network."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from support import ROOT

pytestmark = pytest.mark.browser

LOG = ROOT / "tests" / "data" / "sitl_4circle_cut.tlog"
STUDIES: dict[str, tuple[str | Path, ...]] = {
    "paper": (),
    "dt": (),
    "link": (LOG, "--center", "5:1", "--snr", "4:20:8", "--instants", "4", "--blocks", "2"),
    "prediction": (LOG, "--center", "5:1", "--lead", "0,1", "--jobs", "1"),
    "beams": (LOG, "--center", "5:1", "--hz", "0.5"),
}
FIGURES = """[...document.querySelectorAll("img, svg")].map(one => {
    const { width, height } = one.getBoundingClientRect();
    const right = one.getBoundingClientRect().right <= document.documentElement.clientWidth;
    return { width, height, pixels: one.naturalWidth ?? width, right };
})"""
"""Size of each figure, and of its image: 0 pixels if it could not be loaded."""


@pytest.fixture(scope="module")
def report(studied: Callable[..., Path]) -> Callable[[str], Path]:
    """``report("paper")`` returns the directory of a study's report."""
    return lambda name: studied(name, *map(str, STUDIES[name]))


@pytest.mark.parametrize("name", STUDIES)
def test_report_page_is_self_contained(
    name: str, report: Callable[[str], Path], chromium: Any
) -> None:
    made = report(name)
    context = chromium.new_context(offline=True, viewport={"width": 1280, "height": 900})
    page = context.new_page()
    complaints: list[str] = []
    requests: list[str] = []
    page.on("console", lambda said: said.type == "error" and complaints.append(said.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("requestfailed", lambda request: complaints.append(request.url))
    page.on("request", lambda request: requests.append(request.url))
    address = (made / f"{name}.html").as_uri()
    page.goto(address)
    assert complaints == []
    files = [url for url in requests if urlsplit(url).scheme != "data"]
    assert files == [address]
    figures = page.evaluate(FIGURES)
    assert len(figures) == len(list(made.glob("*.png"))) > 0
    for figure in figures:
        assert min(figure["width"], figure["height"], figure["pixels"]) > 0, figure
        assert figure["right"], figure  # within the page
    command = json.loads((made / f"{name}.json").read_text("utf-8"))["command"]
    assert command in page.inner_text("body")
    context.close()
