"""The dashboard's modules in one script, and its style sheets in one sheet.

A first visit to the page takes a request for each file, and a browser finds out about most modules
only from others. The files are joined when the service starts, so that the page needs no build
step: each module becomes a function that is called once, after those that it imports.
"""

import hashlib
import re
from pathlib import Path
from typing import Final

MAIN: Final = "main.js"
_IMPORT: Final = re.compile(r'^import (\{[^}]*\}|\* as \w+) from "\./(\w+\.js)";\n', re.MULTILINE)
_EXPORT: Final = re.compile(r"^export ((?:async )?function|class|const) ([\w$]+)", re.MULTILINE)
_LEFT: Final = re.compile(r"^(?:import|export)\b", re.MULTILINE)
_SHEET: Final = re.compile(r' *<link rel="stylesheet" href="([\w./]+)">\n')
_SCRIPT: Final = '<script type="module" src="main.js"></script>'


def bundled(root: Path) -> dict[str, bytes]:
    """Return the files of the bundled page by path: the page, its script and its style sheet.

    Script and sheet have a digest of their content in their names, so that browsers may keep them.
    Raises ``ValueError`` for a module that is written in another way than the others.
    """
    page = (root / "index.html").read_text("utf-8")
    sheets = _SHEET.findall(page)
    style = "\n".join((root / name).read_text("utf-8") for name in sheets).encode()
    script = _joined(root).encode()
    style_name, script_name = _named("page.css", style), _named("page.js", script)
    page = _SHEET.sub("", page).replace(
        _SCRIPT,
        f'<link rel="stylesheet" href="{style_name}">\n'
        f'  <script type="module" src="{script_name}"></script>',
    )
    return {"/index.html": page.encode(), f"/{style_name}": style, f"/{script_name}": script}


def _named(name: str, content: bytes) -> str:
    stem, _, suffix = name.partition(".")
    return f"{stem}-{hashlib.sha256(content).hexdigest()[:16]}.{suffix}"


def _joined(root: Path) -> str:
    """Return all modules that the main one needs as one script, in the order of their imports."""
    texts: dict[str, str] = {}

    def add(name: str, importers: tuple[str, ...] = ()) -> None:
        if name in importers:
            raise ValueError(f"{name} imports itself by way of {importers[-1]}")
        if name not in texts:
            text = (root / name).read_text("utf-8")
            for _, imported in _IMPORT.findall(text):
                add(imported, (*importers, name))
            texts[name] = _function(name, text)

    add(MAIN)
    return "".join(texts.values())


def _function(name: str, text: str) -> str:
    """Return a module as a function that returns its exports, and the call of it."""
    exports = ", ".join(found[1] for found in _EXPORT.findall(text))
    body = _EXPORT.sub(r"\1 \2", _IMPORT.sub(_bound, text))
    if (left := _LEFT.search(body)) is not None:
        line = body[: left.start()].count("\n") + 1
        raise ValueError(f"{name}, line {line}: an import or export that cannot be joined")
    return f"const {_variable(name)} = (() => {{\n{body}return {{ {exports} }};\n}})();\n"


def _bound(found: re.Match[str]) -> str:
    names = re.sub(r"(\w+) as (\w+)", r"\1: \2", found[1].removeprefix("* as "))
    return f"const {names} = {_variable(found[2])};\n"


def _variable(name: str) -> str:
    return "module_" + name.removesuffix(".js")
