"""The page under axe-core's rules: no violation at any size, in any theme, with any dialog open."""

from pathlib import Path
from typing import Any

import pytest
from support import HANG_MS, Node

pytestmark = [pytest.mark.browser, pytest.mark.full]

AXE = Path(__file__).parent / "vendor" / "axe.min.js"
SIZES = {
    "desktop": {"width": 1440, "height": 900},
    "tablet": {"width": 1024, "height": 768},
    "phone": {"width": 390, "height": 844},
}
OPENED = {
    "page": "() => {}",
    "help": "() => document.getElementById('help-open').click()",
    "token": "() => document.getElementById('token').showModal()",
    "settings": "() => document.getElementById('settings-open').click()",
    "drawer": "() => document.querySelector('.pick').click()",
}
"""How each dialog is opened, and the page alone."""
VIOLATIONS = """async () => (await axe.run()).violations.flatMap(({ id, nodes }) =>
    nodes.map(({ target, failureSummary }) => `${id}: ${target} ${failureSummary}`))"""


def violations(page: Any) -> list[str]:
    """Return axe's violations, one element per line. (Evaluated, because the page's policy allows
    no other script.)"""
    page.evaluate(AXE.read_text(encoding="utf-8") + ";0")
    found: list[str] = page.evaluate(VIOLATIONS)
    return found


@pytest.mark.parametrize("theme", ["dark", "light"])
@pytest.mark.parametrize("size", SIZES)
def test_axe_finds_no_violation(demo: Node, open_page: Any, size: str, theme: str) -> None:
    page = open_page(demo.url, SIZES[size], theme=theme)
    found = {}
    for name, opened in OPENED.items():
        page.locator(".pick").nth(3).wait_for(timeout=HANG_MS)
        page.locator("#links li dl").first.wait_for(state="attached", timeout=HANG_MS)
        page.evaluate(opened)
        if name != "page":
            page.locator(f"#{name}").wait_for(timeout=HANG_MS)
        if name == "settings":
            page.locator("#settings-set dd").first.wait_for(timeout=HANG_MS)
            page.locator("#settings summary").click()
        found[name] = violations(page)
        page.reload()
    assert found == {name: [] for name in OPENED}


def test_axe_detects_a_violation(demo: Node, open_page: Any) -> None:
    page = open_page(demo.url, SIZES["desktop"])
    page.locator(".pick").first.wait_for(timeout=HANG_MS)
    page.evaluate("document.getElementById('readiness').style.color = '#223'")
    kinds = {line.partition(":")[0] for line in violations(page)}
    assert kinds == {"color-contrast"}
