"""The 3D view: opened by button or key, rotated by both, and equally accessible."""

from typing import Any

import pytest
from support import HANG_MS, Node

from .test_accessibility import SIZES, violations
from .test_layout import CUT, OVERLAPS
from .test_page import UAVS, wait_for_uavs

pytestmark = [pytest.mark.browser, pytest.mark.full]

PICTURE = "document.getElementById('plan').toDataURL()"


@pytest.mark.parametrize("size", SIZES)
def test_3d_view_opens_on_request_and_rotates(demo: Node, open_page: Any, size: str) -> None:
    page = open_page(demo.url, SIZES[size])
    wait_for_uavs(page)
    page.locator("#pause").click()  # from now on the view moves by key only
    button = page.get_by_role("button", name="3D")
    button.click()
    page.locator("#space[aria-pressed=true]").wait_for(timeout=HANG_MS)
    assert page.locator("#plan").get_attribute("aria-label").startswith("3D view: ")
    for key in ("]", "."):
        before = page.evaluate(PICTURE)
        page.keyboard.press(key)
        while page.evaluate(PICTURE) == before:
            page.wait_for_timeout(50)  # until the next frame; a hanging test is terminated
    assert page.evaluate(OVERLAPS) == []
    assert page.evaluate(CUT) == []
    assert violations(page) == []
    page.keyboard.press("v")
    page.locator("#space[aria-pressed=false]").wait_for(timeout=HANG_MS)
    assert page.locator("tbody .pick").count() == len(UAVS)
