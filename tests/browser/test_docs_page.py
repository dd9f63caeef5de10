"""The API documentation page in a browser: rendered without internet, with the tab's token."""

import json
from typing import Any

import pytest

pytestmark = pytest.mark.full
LISTENING = ("run", "--link", "udpin:127.0.0.1:0", "--listen", "127.0.0.1:0", "--center", "1:1")


def test_api_document_renders_and_sends_requests(
    chromium: Any, start_node: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COMPANION_TOKEN", "s3cret")
    url = start_node(*LISTENING).url
    page = chromium.new_page()
    elsewhere: list[str] = []
    page.on("request", lambda asked: elsewhere.append(asked.url))
    said: list[str] = []
    page.on("console", lambda line: said.append(line.text))
    page.goto(f"{url}/docs")
    page.locator(".opblock").first.wait_for()
    paths = json.loads(page.request.get(f"{url}/openapi.json").text())["paths"]
    assert page.locator(".opblock").count() == len(paths)
    page.evaluate("sessionStorage.setItem('companion-token', 's3cret')")
    page.reload()
    status = page.locator("#operations-default-status_v1_status_get")
    status.locator("button").first.click()
    status.get_by_text("Try it out").click()
    status.get_by_text("Execute").click()
    answered = status.locator(".live-responses-table tbody .response-col_status")
    answered.wait_for()
    assert answered.inner_text().split()[0] == "200"
    assert {address for address in elsewhere if not address.startswith((url, "data:"))} == set()
    assert said == []  # a policy violation is logged on the console
    page.close()
