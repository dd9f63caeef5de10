"""The browser and the running demo shared by the page tests."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support import HANG_MS, Node, end

CHROMIUM = Path("/usr/bin/chromium")
QUIET = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """Open a headless browser for one module: its event loop runs in this thread while it is
    open.
    """
    if not CHROMIUM.exists():
        pytest.skip(f"no {CHROMIUM}: install chromium to test the page")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=list(QUIET))
        yield browser
        browser.close()


def start_demo(directory: Path, port: int = 0) -> Node:
    """Start the demo, recording to ``directory``, and wait for its four beams."""
    before = Path.cwd()
    os.chdir(directory)  # recordings go to ./recordings
    try:
        node = Node("demo", "--port", str(port), "--seconds", "36000")
    finally:
        os.chdir(before)
    node.wait_until("/v1/beams", lambda answer: len(answer["beams"]) == 4)
    return node


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Node]:
    """Run one demo for all tests of a module that do not stop it."""
    node = start_demo(tmp_path_factory.mktemp("demo"))
    yield node
    node.stop()


def is_console_error(said: Any) -> bool:
    """Return whether a console message reports an error. Chromium reports each unsuccessful
    response, and 503 is the correct response of an overloaded service."""
    return said.type == "error" and "status of 503" not in said.text


@pytest.fixture
def open_page(chromium: Any) -> Iterator[Any]:
    """Open pages; at the end none may have logged errors other than the expected ones."""
    pages: list[tuple[Any, list[str], bool]] = []

    def start(
        url: str, viewport: dict[str, int], *, loses_service: bool = False, theme: Any = "dark"
    ) -> Any:
        page = chromium.new_page(viewport=viewport, color_scheme=theme)
        page.set_default_timeout(HANG_MS)
        complaints: list[str] = []
        page.on("console", lambda said: is_console_error(said) and complaints.append(said.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        pages.append((page, complaints, loses_service))
        page.goto(url)
        return page

    yield start
    for page, complaints, loses_service in pages:
        page.close()
        # Chromium logs every missing or unsuccessful response, which are expected then.
        unheard = [text for text in complaints if not text.startswith("Failed to load resource")]
        assert (unheard if loses_service else complaints) == []


@pytest.fixture
def start_own_demo(tmp_path: Path) -> Iterator[Any]:
    """Start demos for one test, and stop those left running."""
    nodes: list[Node] = []

    def start(port: int = 0) -> Node:
        nodes.append(start_demo(tmp_path, port))
        return nodes[-1]

    yield start
    for node in nodes:
        end(node.process)
