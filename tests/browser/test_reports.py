"""The pages of all studies in a real browser, from the file system and without a network."""

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from support import BIN, ROOT

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
"""What each figure takes up, and whether its image could be read: 0 pixels where it could not."""


@pytest.fixture(scope="module")
def reports(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A directory with a report of each study, all made at the same time."""
    out = tmp_path_factory.mktemp("reports")
    running = {
        name: subprocess.Popen(
            [BIN / "companion", "study", name, *arguments, "--out", out / name],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )
        for name, arguments in STUDIES.items()
    }
    try:
        for name, process in running.items():
            _, said = process.communicate(timeout=100)
            assert process.returncode == 0, (name, said)
        yield out
    finally:
        for process in running.values():
            if process.poll() is None:
                process.kill()
                process.communicate()


@pytest.mark.parametrize("name", STUDIES)
def test_a_report_needs_nothing_else(name: str, reports: Path, chromium: Any) -> None:
    context = chromium.new_context(offline=True, viewport={"width": 1280, "height": 900})
    page = context.new_page()
    complaints: list[str] = []
    requests: list[str] = []
    page.on("console", lambda said: said.type == "error" and complaints.append(said.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("requestfailed", lambda request: complaints.append(request.url))
    page.on("request", lambda request: requests.append(request.url))
    address = (reports / name / f"{name}.html").as_uri()
    page.goto(address)
    assert complaints == []
    files = [url for url in requests if urlsplit(url).scheme != "data"]
    assert files == [address]
    figures = page.evaluate(FIGURES)
    assert len(figures) == len(list((reports / name).glob("*.png"))) > 0
    for figure in figures:
        assert min(figure["width"], figure["height"], figure["pixels"]) > 0, figure
        assert figure["right"], figure  # within the page
    command = json.loads((reports / name / f"{name}.json").read_text("utf-8"))["command"]
    assert command in page.inner_text("body")
    context.close()
