"""The page's modules joined in one script, and its style sheets in one sheet."""

import re
from pathlib import Path

import pytest

from companion.server.page import FOR_EVER, PageFiles, web_directory
from companion.server.page_bundle import bundled

PAGE = '<link rel="stylesheet" href="a.css">\n<script type="module" src="main.js"></script>\n'


def made(root: Path, **modules: str) -> dict[str, bytes]:
    """Return the bundle of a page with these modules."""
    (root / "index.html").write_text(PAGE)
    (root / "a.css").write_text("p {}")
    for name, text in modules.items():
        (root / f"{name}.js").write_text(text)
    return bundled(root)


def script(files: dict[str, bytes]) -> str:
    """Return the script of a bundle."""
    return next(content for name, content in files.items() if name.endswith(".js")).decode()


def test_module_comes_after_those_that_it_imports(tmp_path: Path) -> None:
    files = made(
        tmp_path,
        main='import { a as b } from "./one.js";\nimport * as two from "./two.js";\nb(two.x);\n',
        one='import { x } from "./two.js";\nexport function a() { return x; }\nconst own = 1;\n',
        two="export const x = 1;\nconst own = 2;\n",
    )
    order = re.findall(r"^const module_(\w+) =", script(files), re.MULTILINE)
    assert order == ["two", "one", "main"]
    assert "const { a: b } = module_one;" in script(files)
    assert "const two = module_two;" in script(files)


@pytest.mark.parametrize("line", ["export default 1;", 'import "./one.js";', "export { x };"])
def test_module_that_cannot_be_joined_is_an_error(tmp_path: Path, line: str) -> None:
    with pytest.raises(ValueError, match=r"main\.js, line 1"):
        made(tmp_path, main=f"{line}\n", one="")


def test_modules_that_import_each_other_are_an_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="imports itself"):
        made(tmp_path, main='import { m } from "./main.js";\n')


def test_name_changes_with_the_content_and_the_file_is_kept_for_ever(tmp_path: Path) -> None:
    before, after = made(tmp_path, main="a();\n"), made(tmp_path, main="b();\n")
    assert len(set(before) & set(after)) == 2  # the page and its sheet
    page = PageFiles(tmp_path)
    (name,) = (one for one in after if one.endswith(".js"))
    assert name.removeprefix("/") in after["/index.html"].decode()
    scope = {"type": "http", "method": "GET", "headers": []}
    assert page.answer(name, scope).headers["cache-control"] == FOR_EVER
    assert "cache-control" not in page.answer("/", scope).headers


def test_every_module_of_the_page_is_in_its_script() -> None:
    """Except those of the documentation of the API, which is a page of its own."""
    joined = set(
        re.findall(r"^const module_(\w+) =", script(bundled(web_directory())), re.MULTILINE)
    )
    assert joined == {file.stem for file in web_directory().glob("*.js")} - {"docs"}
