"""The dashboard in a real browser, on the running demo. Pictures go to ``out/screens``."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support import ROOT, Node

pytestmark = pytest.mark.browser

CHROMIUM = Path("/usr/bin/chromium")
SCREENS = ROOT / "out" / "screens"
QUIET = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """A headless browser."""
    if not CHROMIUM.exists():
        pytest.skip(f"no {CHROMIUM}: install chromium to test the page")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=list(QUIET))
        yield browser
        browser.close()


@pytest.fixture
def demo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Node]:
    """The demo, once its four beams are up."""
    monkeypatch.chdir(tmp_path)  # it records to ./recordings
    node = Node("demo", "--port", "0", "--seconds", "60")
    node.wait_until("/v1/beams", lambda answer: len(answer["beams"]) == 4)
    yield node
    node.stop()


@pytest.mark.parametrize(("name", "width", "height"), [("desktop", 1440, 900), ("phone", 390, 844)])
def test_every_uav_is_shown_and_moves(
    chromium: Any, demo: Node, name: str, width: int, height: int
) -> None:
    page = chromium.new_page(viewport={"width": width, "height": height})
    complaints: list[str] = []
    page.on("console", lambda said: complaints.append(said.text) if said.type == "error" else None)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto(demo.url)
    for uav in ("1:1", "2:1", "3:1", "4:1"):
        page.get_by_text(uav, exact=True).first.wait_for(timeout=3000)
    page.get_by_text("ready", exact=True).first.wait_for(timeout=3000)
    before = page.inner_text("table")
    page.wait_for_function("text => document.querySelector('table').innerText !== text", arg=before)
    page.wait_for_timeout(5000)  # for the picture alone: trails need some seconds to draw
    SCREENS.mkdir(parents=True, exist_ok=True)
    page.screenshot(path=SCREENS / f"{name}.png")
    assert complaints == []
    page.close()


def test_a_lost_service_is_unmistakable(chromium: Any, demo: Node) -> None:
    page = chromium.new_page(viewport={"width": 1440, "height": 900})
    page.goto(demo.url)
    page.get_by_text("1:1", exact=True).first.wait_for(timeout=3000)
    demo.process.kill()
    demo.process.communicate()
    page.get_by_text("CONNECTION LOST").first.wait_for(timeout=4000)
    SCREENS.mkdir(parents=True, exist_ok=True)
    page.screenshot(path=SCREENS / "lost.png")
    page.close()
