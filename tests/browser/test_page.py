"""The dashboard in a real browser, on the running demo.

Screenshots go to ``out/screens``; with ``KEEP_SCREENS`` set, to ``docs`` as well.
"""

import functools
import io
import os
import re
import shutil
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from support import BIN, HANG_MS, HANG_S, ROOT, Node, end, line_of, started

from .test_accessibility import violations

pytestmark = pytest.mark.browser

SCREENS = ROOT / "docs" if os.environ.get("KEEP_SCREENS") else ROOT / "out" / "screens"
UAVS = ("1:1", "2:1", "3:1", "4:1")
DESKTOP = {"width": 1440, "height": 900}
PHONE = {"width": 390, "height": 844}
REQUESTS_PER_S = 5.0
OVERFLOW = "document.documentElement.scrollWidth - innerWidth"
AZIMUTHS = (
    "[...document.querySelectorAll('td[data-key=azimuth]')].map(cell => cell.innerText).join()"
)


def wait_for_uavs(page: Any) -> None:
    """Wait until every UAV of the demo is in the table."""
    for uav in UAVS:
        page.locator("#uavs").get_by_text(uav, exact=True).wait_for(timeout=HANG_MS)


def wait_for_value(page: Any, expression: str, wanted: object) -> None:
    """Wait until an expression has a value. (Playwright's own method evaluates text in the page,
    which the content policy forbids.)"""
    end = time.monotonic() + HANG_S
    while (found := page.evaluate(expression)) != wanted:
        assert time.monotonic() < end, found
        page.wait_for_timeout(50)


def picture(page: Any, name: str) -> None:
    """Save a screenshot in 256 colours."""
    SCREENS.mkdir(parents=True, exist_ok=True)
    shot = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    shot.quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(
        SCREENS / f"{name}.png", optimize=True
    )


def drawn_colours(page: Any, canvas: str) -> int:
    """Return the number of colours in a picture: one if nothing was drawn."""
    return int(
        page.evaluate(
            """id => {
                const canvas = document.querySelector(id);
                const { data } = canvas.getContext("2d")
                    .getImageData(0, 0, canvas.width, canvas.height);
                return new Set(new Uint32Array(data.buffer)).size;
            }""",
            canvas,
        )
    )


def test_page_updates_within_the_request_limit(demo: Node, open_page: Any) -> None:
    page = open_page(demo.url, DESKTOP)
    wait_for_uavs(page)
    page.get_by_text("ready", exact=True).wait_for(timeout=HANG_MS)
    before = page.evaluate(AZIMUTHS)
    page.wait_for_function(f"before => {AZIMUTHS} !== before", arg=before, timeout=HANG_MS)
    page.locator("#pattern-facts [data-fact=peak]").get_by_text("dB").wait_for(timeout=HANG_MS)
    page.locator("#links").get_by_text("udpin:").wait_for(timeout=HANG_MS)
    page.locator("#events").get_by_text("4:1 is live").first.wait_for(timeout=HANG_MS)
    page.wait_for_timeout(6000)  # so that the series and the request rate are meaningful
    times = page.evaluate("performance.getEntriesByType('resource')"
                          ".filter(one => one.initiatorType === 'fetch')"
                          ".map(one => one.startTime)")  # fmt: skip
    recent = [at for at in times if at > max(times) - 5000]
    assert len(recent) / 5 <= REQUESTS_PER_S * 1.1
    canvases = ["#plan", "#pattern", "#elements"]
    canvases += [f"#chart-{one} canvas" for one in ("pointing", "innovation", "latency", "gain")]
    for canvas in canvases:
        assert drawn_colours(page, canvas) > 5, canvas
    assert page.evaluate(OVERFLOW) == 0
    page.locator("#recordings-panel").wait_for(timeout=HANG_MS)
    picture(page, "dashboard")


@pytest.mark.full
def test_keyboard_selects_pauses_and_steps_back(demo: Node, open_page: Any) -> None:
    page = open_page(demo.url, DESKTOP)
    wait_for_uavs(page)
    page.locator("#uavs th[data-key=id] button").click()  # by name: the worst-first order changes
    page.keyboard.press("2")
    assert page.locator(".pick[aria-pressed=true]").inner_text() == "2:1"
    page.keyboard.press("ArrowDown")
    assert page.locator(".pick[aria-pressed=true]").inner_text() == "3:1"
    page.keyboard.press("Escape")
    assert page.locator(".pick[aria-pressed=true]").count() == 0
    seen = remember_azimuths(page, seconds=4)
    page.keyboard.press("Space")
    paused = page.evaluate(AZIMUTHS)
    assert page.locator("#past").is_visible()
    assert "NOT LIVE" in page.locator("#past").inner_text()
    assert page.title().startswith("PAUSED")
    page.wait_for_timeout(1200)  # more than one polling period: the page must not change
    assert page.evaluate(AZIMUTHS) == paused
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("ArrowLeft")
    past = page.evaluate(AZIMUTHS)
    assert past != paused and past in seen
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    assert page.evaluate(AZIMUTHS) == paused
    page.keyboard.press("End")
    assert page.locator("#past").is_hidden()
    page.wait_for_function(
        f"seen => !seen.includes({AZIMUTHS})", arg=[*seen, paused], timeout=HANG_MS
    )
    page.keyboard.press("?")
    assert page.locator("#help").is_visible()
    page.keyboard.press("Escape")
    assert page.locator("#help").is_hidden()


def remember_azimuths(page: Any, seconds: float) -> list[str]:
    """Return every state of the table's azimuths over some seconds."""
    seen: list[str] = page.evaluate(
        f"""async milliseconds => {{
            const seen = new Set();
            const end = performance.now() + milliseconds;
            while (performance.now() < end) {{
                seen.add({AZIMUTHS});
                await new Promise(requestAnimationFrame);
            }}
            return [...seen];
        }}""",
        seconds * 1000,
    )
    return seen


@pytest.mark.full
def test_slider_steps_back_in_time(demo: Node, open_page: Any) -> None:
    page = open_page(demo.url, PHONE)
    wait_for_uavs(page)
    seen = remember_azimuths(page, seconds=2.5)
    page.locator("#scrub").fill("-1")
    assert page.locator("#past").is_visible()
    assert page.evaluate(AZIMUTHS) in seen
    page.get_by_role("button", name="▶ Live").click()
    assert page.locator("#past").is_hidden()
    picture(page, "dashboard-phone")


def fulfil(answer: Any, route: Any) -> None:
    """Respond in place of a service that has recordings."""
    route.fulfill(json=answer)


def test_recordings_are_listed_with_links(demo: Node, open_page: Any) -> None:
    page = open_page("about:blank", DESKTOP)
    answers: dict[str, Any] = {
        "/v1/recordings": {"recordings": [{"name": "a b.mcap", "bytes": 1500, "state": "closed"}]}
    }
    for path, answer in answers.items():
        page.route(f"**{path}", functools.partial(fulfil, answer))
    page.goto(demo.url)
    page.locator("#recordings-panel summary").click(timeout=HANG_MS)
    link = page.get_by_role("link", name="a b.mcap")
    link.wait_for(timeout=HANG_MS)
    assert link.get_attribute("href") == "/v1/recordings/a%20b.mcap"
    assert "1.5\u00a0kB · closed" in page.locator("#recordings").text_content()


@pytest.mark.full
def test_page_fits_the_width_of_a_phone(demo: Node, open_page: Any) -> None:
    page = open_page(demo.url, PHONE)
    wait_for_uavs(page)
    page.locator("#links").get_by_text("udpin:").wait_for(timeout=HANG_MS)
    assert page.evaluate(OVERFLOW) == 0
    cut = page.evaluate("""[...document.querySelectorAll("main *, header *")]
        .filter(one => one.checkVisibility() && !one.closest(".hidden, .u-wrap"))
        .filter(one => one.getBoundingClientRect().right > innerWidth + 0.5)
        .map(one => one.tagName + "." + one.className)""")
    assert cut == []
    assert page.locator("#pause").bounding_box()["height"] >= 40  # large enough for gloves


@pytest.mark.full
def test_themes_are_remembered_and_legible(demo: Node, open_page: Any) -> None:
    page = open_page(demo.url, DESKTOP)
    wait_for_uavs(page)
    for theme in ("dark", "light"):
        assert page.locator("html").get_attribute("data-theme") == theme
        ratios = page.evaluate(CONTRASTS)
        assert ratios["text"] >= 12 and ratios["muted"] >= 6, ratios
        assert min(ratios.values()) >= 4.5, ratios
        page.keyboard.press("t")
    page.keyboard.press("t")
    page.reload()
    wait_for_uavs(page)
    assert page.locator("html").get_attribute("data-theme") == "light"
    page.wait_for_timeout(4000)  # for the screenshot only
    picture(page, "dashboard-light")


CONTRASTS = """(() => {
    const style = getComputedStyle(document.documentElement);
    const light = name => {
        const hex = style.getPropertyValue("--" + name).trim();
        const [r, g, b] = [1, 3, 5].map(i => parseInt(hex.slice(i, i + 2), 16) / 255)
            .map(c => c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
        return 0.2126 * r + 0.7152 * g + 0.0722 * b;
    };
    const names = ["text", "muted", "live", "coast", "stale", "beam", "warn", "bad"];
    return Object.fromEntries(names.map(name => {
        const [a, b] = [light(name), light("panel")].sort((x, y) => y - x);
        return [name, (a + 0.05) / (b + 0.05)];
    }));
})()"""
"""Contrast with the panels by WCAG 2: 4.5 for text, 7 where it must be readable in sunlight."""


@pytest.mark.full
def test_lost_service_is_marked_and_recovers(open_page: Any, start_own_demo: Any) -> None:
    node = start_own_demo()
    page = open_page(node.url, DESKTOP, loses_service=True)
    wait_for_uavs(page)
    style = "getComputedStyle(document.querySelector('td[data-key=range] span')).{}"
    node.process.send_signal(signal.SIGSTOP)  # silent, but still running
    page.locator("html[data-uavs-late]").wait_for(state="attached", timeout=HANG_MS)
    assert page.evaluate(style.format("fontStyle")) == "italic"
    node.process.send_signal(signal.SIGCONT)
    fresh = page.locator("html:not([data-uavs-late]):not([data-uavs-lost])")
    fresh.wait_for(state="attached", timeout=HANG_MS)
    wait_for_value(page, style.format("fontStyle"), "normal")
    end(node.process)
    killed = time.monotonic()
    page.get_by_text("CONNECTION LOST", exact=True).wait_for(timeout=HANG_MS)
    assert time.monotonic() - killed < 4
    assert page.evaluate(style.format("textDecorationLine")) == "line-through"
    headline = "getComputedStyle(document.querySelector('#headline')).textDecorationLine"
    assert page.evaluate(headline) == "line-through"
    start_own_demo(port=int(node.url.rpartition(":")[2]))
    page.locator("#banner").wait_for(state="hidden", timeout=HANG_MS)
    page.get_by_text("SERVICE RESTARTED").wait_for(timeout=HANG_MS)
    assert re.search(r"No data from \S+ to \S+ UTC \(.+\ss\)", page.inner_text("#outage"))
    page.locator("#outage-seen").click()
    page.locator("#outage").wait_for(state="hidden", timeout=HANG_MS)
    assert page.evaluate(headline) == "none"
    page.get_by_text("connected", exact=True).wait_for(timeout=HANG_MS)
    wait_for_value(page, style.format("textDecorationLine"), "none")


def test_console_is_clean_while_the_service_starts(open_page: Any, tmp_path: Path) -> None:
    """Without a carrier the service is not ready and has no beams, which is no error."""
    options = ("--center", "99:1", "--listen", "127.0.0.1:0", "--record", str(tmp_path))
    node = Node("run", "--link", "udpin:127.0.0.1:0", *options)
    try:
        page = open_page("about:blank", DESKTOP)
        failed: list[str] = []
        page.on("response", lambda one: one.ok or failed.append(f"{one.status} {one.url}"))
        page.goto(node.url)
        page.get_by_text("not ready", exact=True).wait_for()
        page.get_by_text("No UAV has reported a position.").wait_for()
        for path in ("/v1/links", "/v1/events", "/v1/status"):
            page.wait_for_event("response", lambda one, path=path: one.url.endswith(path))
        assert failed == []
        page.close()  # before the service ends
    finally:
        end(node.process)


def test_page_asks_for_the_token_and_stores_it(
    open_page: Any, cut_log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COMPANION_TOKEN", "s3cret/ü")
    command = [BIN / "companion", "replay", cut_log, "--center", "5:1", "--no-record", "--serve"]
    pipes: Any = {"stderr": subprocess.PIPE, "stdout": subprocess.DEVNULL, "text": True}
    with started([*command, "--listen", "127.0.0.1:0"], **pipes) as process:
        lines = iter(lambda: line_of(process, process.stderr), "")
        said = (re.search(r"serves (http://\S+) and", line) for line in lines)
        url = next(found for found in said if found)[1]
        page = open_page(url, DESKTOP, loses_service=True)
        field = page.get_by_label("Bearer token")
        field.wait_for()
        page.get_by_text("token needed", exact=True).wait_for()
        statuses = page.evaluate(
            "performance.getEntriesByType('resource').map(one => one.responseStatus)"
        )
        assert statuses and max(statuses) < 400  # nothing is refused before a token is entered
        assert not page.locator("#token-problem").is_visible()
        field.fill("wrong")
        page.get_by_role("button", name="Connect").click()
        page.get_by_text("That token is wrong.").wait_for()
        picture(page, "token")
        field.fill("s3cret/ü")
        page.keyboard.press("Enter")
        wait_for_uavs(page)
        page.reload()
        wait_for_uavs(page)
        assert not field.is_visible()
        process.terminate()
        process.communicate(timeout=HANG_S)


@pytest.mark.full
def test_replay_is_labelled_on_the_page(open_page: Any, cut_log: Path) -> None:
    command = [BIN / "companion", "replay", cut_log, "--center", "5:1", "--no-record", "--serve"]
    with started(
        [*command, "--listen", "127.0.0.1:0"],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    ) as process:
        lines = iter(lambda: line_of(process, process.stderr), "")
        said = (re.search(r"serves (http://\S+) and", line) for line in lines)
        url = next(found for found in said if found)[1]
        page = open_page(url, DESKTOP, loses_service=True)
        page.locator("#replay").get_by_text("replay sitl_4circle_cut.tlog").wait_for()
        wait_for_uavs(page)
        process.terminate()
        process.communicate(timeout=HANG_S)


FIRST_LOAD_REQUESTS = 20
FIRST_LOAD_BYTES = 120_000


def test_first_load_takes_few_requests_and_bytes(demo: Node, open_page: Any) -> None:
    page = open_page("about:blank", DESKTOP)
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto(demo.url)
    wait_for_uavs(page)
    page.locator("#recordings-panel").wait_for(timeout=HANG_MS)
    page.locator("#series-key li").nth(3).wait_for(timeout=HANG_MS)
    files = [url for url in asked if "/v1/" not in url]
    firsts = {url.partition("?")[0] for url in asked}
    assert len(files) <= 8 and len(firsts) <= FIRST_LOAD_REQUESTS, asked
    took = page.evaluate(
        "performance.getEntriesByType('resource').map(one => [one.name, one.encodedBodySize])"
    )
    sizes = {url: size for url, size in took if "/v1/" not in url}
    assert sum(sizes.values()) <= FIRST_LOAD_BYTES, sizes
    before = len(asked)
    page.reload()
    wait_for_uavs(page)
    again = [url for url in asked[before:] if re.search(r"/page-\w+\.(css|js)$", url)]
    kept = page.evaluate(
        "performance.getEntriesByType('resource').filter(one => /page-/.test(one.name))"
        ".map(one => one.transferSize)"
    )
    assert len(again) == 2 and kept == [0, 0]  # from the browser's cache


def test_page_just_opened_looks_back_over_what_the_service_keeps(
    demo: Node, open_page: Any
) -> None:
    demo.wait_until("/v1/history", lambda answer: len(answer["at"]) >= 20)
    page = open_page(demo.url, DESKTOP)
    wait_for_uavs(page)
    reach = "Number(document.querySelector('#scrub').min) <= -15"
    wait_for_value(page, reach, True)
    page.locator("#scrub").fill("-12")
    page.locator("#past-detail").get_by_text("From the service's samples").wait_for()
    assert page.locator("tbody tr[data-verdict]").count() == len(UAVS)
    azimuths = page.evaluate(AZIMUTHS)
    ranges = page.locator("td[data-key=range]").all_inner_texts()
    assert "–" not in azimuths and all(text.endswith("m") for text in ranges)
    page.locator("#scrub").blur()  # which takes arrow keys itself
    page.keyboard.press("ArrowLeft")
    assert page.evaluate(AZIMUTHS) != azimuths
    page.keyboard.press("End")
    page.locator("#past").wait_for(state="hidden")


def test_recording_is_played_on_the_page_and_marked(open_page: Any, tmp_path: Path) -> None:
    shutil.copy(ROOT / "tests" / "data" / "sitl_4circle_cut.tlog", tmp_path / "flight.mcap")
    options = ("--center", "99:1", "--listen", "127.0.0.1:0", "--record", str(tmp_path))
    node = Node("run", "--link", "udpin:127.0.0.1:0", *options)
    try:
        page = open_page(node.url, DESKTOP)
        page.get_by_text("No UAV has reported a position.").wait_for()
        page.locator("#recordings-panel summary").click()
        page.get_by_role("button", name="Play flight.mcap").click()
        page.get_by_text("RECORDING – NOT LIVE").wait_for()
        page.locator("tbody tr").nth(3).wait_for()
        assert page.title().startswith("RECORDING")
        first = page.inner_text("#past-detail")
        assert first.startswith("flight.mcap: ")
        page.locator("#speed").click()
        wait_for_value(
            page, f"document.querySelector('#past-detail').innerText !== {first!r}", True
        )
        page.get_by_role("button", name="Pause").click()
        page.get_by_role("button", name="▶ Play").wait_for()
        page.locator("#scrub").fill("-1")
        assert page.inner_text("#past-detail") != first
        assert violations(page) == []
        page.get_by_role("button", name="Back to live").click()
        page.locator("#past").wait_for(state="hidden")
        page.get_by_text("No UAV has reported a position.").wait_for()
        page.close()
    finally:
        end(node.process)
