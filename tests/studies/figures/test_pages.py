"""Pages: values are escaped, and a missing value is an error."""

import pytest
from jinja2 import UndefinedError

from companion.studies.figures import pages

PAGE = "figures/page.html.j2"
EVIL = "x\"y'></code></style><script>"


def test_page_values_are_escaped() -> None:
    answer = {"command": EVIL, "versions": {EVIL: EVIL}}
    figure = {"name": EVIL, "caption": EVIL, "png_base64": ""}
    page = pages.page(PAGE, answer=answer, figures={"one": figure})
    assert EVIL not in page and "<script>" not in page and 'x"y' not in page
    assert page.count("&gt;&lt;script&gt;") == 3 + 3  # generator; id, alternative text, caption


def test_page_is_reproducible_and_self_contained() -> None:
    answer = {"command": "companion study", "versions": {"numpy": "2", "scipy": "1"}}
    page = pages.page(PAGE, answer=answer, figures={})
    assert page == pages.page(PAGE, answer=answer, figures={})
    assert page.startswith("<!doctype html>") and page.endswith("</html>\n")
    assert "<code>companion study</code><br>numpy 2, scipy 1</p>" in page
    assert "http" not in page


def test_missing_page_value_raises() -> None:
    with pytest.raises(UndefinedError, match="answer"):
        pages.page(PAGE, figures={})
    with pytest.raises(UndefinedError, match="command"):
        pages.page(PAGE, answer={"versions": {}}, figures={})
