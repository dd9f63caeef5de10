"""The page at every size, with few and many UAVs: nothing overlaps or is cut off."""

import functools
from typing import Any
from urllib.parse import urlsplit

import pytest
from support import HANG_MS, Node

pytestmark = pytest.mark.browser

SIZES = {
    "desktop": {"width": 1440, "height": 900},
    "tablet": {"width": 1024, "height": 768},
    "phone": {"width": 390, "height": 844},
}
OVERLAPS = """() => {
    const groups = ["header > *, header .facts div", ".zoom, .legend-fold", ".time > *",
        ".focus summary, .focus h3, .focus canvas, .focus dl", ".side section",
        ".charts figure, #series-key",
        "thead th", "tbody tr:nth-child(-n+12) :is(td, th):not(:first-child)", ".events li",
        ".find > *", "main > *:not(.side, .time), .side section", "#fleet-nodes *",
        "#fleet-uavs tr:nth-child(-n+4) :is(td, th)", ".fleet > div"];
    const seen = one => {
        let { left, top, right, bottom } = one.getBoundingClientRect();
        for (let at = one.parentElement; at; at = at.parentElement) {
            if (getComputedStyle(at).overflowY === "visible") continue;
            const clip = at.getBoundingClientRect();
            [left, top] = [Math.max(left, clip.left), Math.max(top, clip.top)];
            [right, bottom] = [Math.min(right, clip.right), Math.min(bottom, clip.bottom)];
        }
        return { left, top, right, bottom };
    };
    const found = [];
    for (const group of groups) {
        const all = [...document.querySelectorAll(group)].filter(one => one.checkVisibility())
            .map(one => ({ one, box: seen(one) }))
            .filter(({ box }) => box.right - box.left > 1 && box.bottom - box.top > 1);
        all.forEach((a, i) => all.slice(i + 1).forEach(b => {
            if (a.one.contains(b.one) || b.one.contains(a.one)) return;
            const wide = Math.min(a.box.right, b.box.right) - Math.max(a.box.left, b.box.left);
            const high = Math.min(a.box.bottom, b.box.bottom) - Math.max(a.box.top, b.box.top);
            if (wide > 1 && high > 1) found.push([a, b].map(({ one }) =>
                `${one.tagName}#${one.id}.${one.className} ${one.textContent.slice(0, 20)}`));
        }));
    }
    return found;
}"""
"""Pairs of elements of one group whose visible boxes overlap."""
CUT = """() => [...document.querySelectorAll("header *, .side h2, .side p, h2, .chip, .button")]
    .filter(one => one.checkVisibility() && !one.closest(".hidden"))
    .filter(one => one.getBoundingClientRect().right > innerWidth + 0.5
        || one.scrollWidth > one.clientWidth + 1 && getComputedStyle(one).display !== "inline")
    .map(one => `${one.tagName}#${one.id} ${one.textContent.slice(0, 30)}`)"""


def crowd(answer: dict[str, Any], key: str, name: str, number: int) -> dict[str, Any]:
    """Return the response with its UAVs repeated up to the wanted number."""
    several = answer[key]
    levels = ("good", "good", "weak", "none")
    copies = []
    for i in range(number if several else 0):
        one = {**several[i % len(several)], name: f"{i + 1}:1"}
        if name == "id":
            one["verdict"] = levels[i % 4]
            one["health"] = {**(one["health"] or {}), "cause": "rate", "remedy": "ask for 10 Hz",
                             "reason": f"reports {1 + i % 3}.1 s apart"}  # fmt: skip
        copies.append(one)
    return {**answer, key: copies}


def many(node: Node, page: Any, number: int) -> None:
    """Show the page the wanted number of UAVs, independent of the demo."""

    def fulfil(path: str, key: str, name: str, route: Any) -> None:
        route.fulfill(json=crowd(node.json(path), key, name, number))

    for path, key, name in (("/v1/uavs", "uavs", "id"), ("/v1/beams", "beams", "uav")):
        page.route(f"**{path}?rounded=true", functools.partial(fulfil, path, key, name))


def open_with_twenty(demo: Node, open_page: Any, size: str) -> Any:
    """Open the page of a demo with twenty UAVs."""
    page = open_page("about:blank", SIZES[size], loses_service=True)
    many(demo, page, 20)
    page.goto(demo.url)
    page.locator("tbody tr").nth(19).wait_for(state="attached", timeout=HANG_MS)
    return page


@pytest.mark.parametrize(
    "number", [*(pytest.param(n, marks=pytest.mark.full) for n in (1, 4, 20)), 100]
)
@pytest.mark.parametrize("size", SIZES)
def test_no_element_overlaps_or_is_cut_off(
    demo: Node, open_page: Any, size: str, number: int
) -> None:
    page = open_page("about:blank", SIZES[size], loses_service=True)
    many(demo, page, number)
    page.goto(demo.url)
    page.locator("tbody tr").nth(number - 1).wait_for(state="attached", timeout=HANG_MS)
    page.locator("#links li dl").first.wait_for(state="attached", timeout=HANG_MS)
    page.locator("#events time").first.wait_for(state="attached", timeout=HANG_MS)
    assert page.evaluate(OVERLAPS) == []
    assert page.evaluate(CUT) == []
    assert page.evaluate("document.documentElement.scrollWidth - innerWidth") == 0


ROOM = """() => {
    const room = innerHeight - document.querySelector(".alerts").offsetHeight;
    const share = one => {
        const { width, top, bottom } = one.getBoundingClientRect();
        return width * (Math.min(bottom, innerHeight) - top) / innerWidth / room;
    };
    const [plan, table] = [document.querySelector(".plan"), document.querySelector(".scroll")];
    const end = Math.min(table.getBoundingClientRect().bottom, innerHeight);
    const rows = [...document.querySelectorAll("#uavs tbody tr")]
        .filter(row => row.getBoundingClientRect().bottom <= end + 1);
    return { plan: share(plan), rows: rows.length };
}"""
"""Share of the window below alerts that the plan takes, and the number of rows in sight.

A busy machine is an alert.
"""


def test_plan_and_table_get_the_room_when_there_are_many_uavs(demo: Node, open_page: Any) -> None:
    page = open_with_twenty(demo, open_page, "desktop")
    page.locator("#fold-charts:not([open])").wait_for(state="attached", timeout=HANG_MS)
    enough = f"() => {{ const room = ({ROOM})(); return room.rows === 20 && room.plan >= 0.3; }}"
    page.wait_for_function(enough, timeout=HANG_MS)  # a header of a busy machine has more lines


def test_fold_is_remembered_and_what_it_hides_is_not_requested(demo: Node, open_page: Any) -> None:
    page = open_page(demo.url, SIZES["desktop"])
    page.locator("#pattern-facts [data-fact=peak]").get_by_text("dB").wait_for(timeout=HANG_MS)
    page.locator("#fold-focus summary").click()
    page.locator("#fold-focus:not([open])").wait_for(state="attached", timeout=HANG_MS)
    paths: list[str] = []
    page.on("request", lambda request: paths.append(urlsplit(request.url).path))
    page.reload()
    page.locator("tbody tr").nth(3).wait_for(state="attached", timeout=HANG_MS)
    for _ in range(4):  # beats, of which each would bring a pattern
        page.wait_for_event("response", lambda one: "/v1/beams?" in one.url)
    assert page.locator("#fold-focus:not([open])").count() == 1
    assert not {"/v1/pattern", "/v1/beams/weights"} & set(paths)
    page.locator("#fold-focus summary").click()
    page.locator("#pattern-facts [data-fact=peak]").get_by_text("dB").wait_for(timeout=HANG_MS)


@pytest.mark.parametrize("size", SIZES)
def test_click_anywhere_on_a_row_opens_the_drawer(demo: Node, open_page: Any, size: str) -> None:
    page = open_page(demo.url, SIZES[size])
    page.locator("tbody tr").nth(3).wait_for(state="attached", timeout=HANG_MS)
    page.locator("#uavs th[data-key=id] button").evaluate("one => one.click()")  # a fixed order
    row = page.locator("#uavs tbody tr[data-id='2:1']")
    cells = row.locator("td").evaluate_all(
        "all => all.filter(one => one.checkVisibility()).map(one => one.dataset.key)"
    )
    for key in cells:
        row.locator(f"td[data-key={key}]").click()
        page.locator("#drawer-title").get_by_text("2:1").wait_for(timeout=HANG_MS)
        page.locator("#drawer-close").click()
        page.locator("#drawer").wait_for(state="hidden", timeout=HANG_MS)
    row.locator(".pick").click()
    page.locator("#drawer").wait_for(timeout=HANG_MS)
    row.locator(".pick").click()
    page.locator("#drawer").wait_for(state="hidden", timeout=HANG_MS)
    assert page.locator(".pick[aria-pressed=true]").count() == 0


COLUMNS_IN_SIGHT = """() => {
    const right = document.querySelector(".scroll").getBoundingClientRect().right;
    return [...document.querySelectorAll("thead th")]
        .filter(one => one.checkVisibility() && one.getBoundingClientRect().right <= right + 0.5)
        .map(one => one.dataset.key);
}"""


def test_actionable_columns_are_visible_on_a_tablet(demo: Node, open_page: Any) -> None:
    page = open_with_twenty(demo, open_page, "tablet")
    wanted = ["id", "verdict", "state", "range", "azimuth", "age", "gain", "guaranteed"]
    assert page.evaluate(COLUMNS_IN_SIGHT) == wanted
    page.get_by_role("button", name="All columns").click()
    assert page.locator("thead th").nth(13).is_visible()
    assert page.locator("thead th[data-key=elevation]").is_visible()
    page.get_by_role("button", name="All columns").click()
    assert page.evaluate(COLUMNS_IN_SIGHT) == wanted


def test_every_column_is_visible_on_a_desktop_in_any_state(demo: Node, open_page: Any) -> None:
    """Signs and bold letters of stale values need more room than good ones."""

    def fulfil(route: Any) -> None:
        answer = crowd(demo.json("/v1/uavs"), "uavs", "id", 4)
        for one in answer["uavs"]:
            one |= {"state": "coasting", "verdict": "weak", "age_s": 3.29, "range_m": 1999.0}
            one |= {"bound_m": 111.1, "error_p95_m": 111.1, "latency_ms": 888.0}
        route.fulfill(json=answer)

    page = open_page("about:blank", SIZES["desktop"], loses_service=True)
    page.route("**/v1/uavs?*", fulfil)
    page.goto(demo.url)
    page.locator("tr[data-state=coasting]").nth(3).wait_for(state="attached", timeout=HANG_MS)
    columns = page.evaluate(
        "[...document.querySelectorAll('thead th')].filter(one => one.checkVisibility())"
        ".map(({ dataset }) => dataset.key)"
    )
    assert page.evaluate(COLUMNS_IN_SIGHT) == columns


def test_overlapping_and_cut_off_elements_are_detected(demo: Node, open_page: Any) -> None:
    page = open_page(demo.url, SIZES["desktop"])
    page.locator("#events time").first.wait_for(timeout=HANG_MS)
    styled = (
        "([of, key, value]) => document.querySelectorAll(of).forEach(one => one.style[key] = value)"
    )
    page.evaluate(styled, [".chip", "marginRight", "-60px"])
    assert page.evaluate(OVERLAPS)
    page.evaluate(styled, [".facts", "transform", "translateX(900px)"])
    assert page.evaluate(CUT)


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_theme_follows_the_browser_preference(demo: Node, open_page: Any, theme: str) -> None:
    page = open_page(demo.url, SIZES["desktop"], theme=theme)
    assert page.locator("html").get_attribute("data-theme") == theme
