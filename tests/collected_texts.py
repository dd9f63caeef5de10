"""Every error, notice and rejection detail that the tests cause, held to the rules for such texts.

With COLLECT_TEXTS=FILE in the environment each of them is appended to that file as a line of JSON:
``make messages`` writes docs/messages.md from it.
"""

import json
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from companion.values import Notice, Rejection, UserError

CHARACTERS_MAX: Final = 200
ROOT: Final = str(Path(__file__).resolve().parents[1])
READ_BACK: Final = ("companion/recording/fields.py", "companion/recording/entries.py")
"""Files that read the texts of recordings."""
_FOLDERS: Final = re.compile(r"/[^ '\":,]*/")  # of the test machine


class CollectedTexts:
    """The texts of the running test."""

    def __init__(self) -> None:
        self._texts: dict[int, dict[str, str]] = {}  # by the id of what holds them
        self._written: set[str] = set()

    def add(self, holder: object, kind: str, text: str, subject: str) -> None:
        """Collect one text. An error raised while another is handled replaces that one."""
        place = _place()
        if place is None or place.startswith(READ_BACK):
            return
        self._texts.pop(id(sys.exc_info()[1]), None)
        self._texts[id(holder)] = {
            "kind": kind, "text": text, "subject": subject, "place": place
        }  # fmt: skip

    def faults(self) -> list[str]:
        """Return the broken rules of the texts of the test that ends, and drop these texts."""
        found = [
            f"{one['place']}: {one['kind']} {wrong}: {one['text']!r}"
            for one in self._texts.values()
            for wrong in broken_rules(**one)
        ]
        self._write()
        self._texts.clear()
        return sorted(set(found))

    def _write(self) -> None:
        lines = {json.dumps(one) for one in self._texts.values()} - self._written
        self._written |= lines
        if (file := os.environ.get("COLLECT_TEXTS")) and lines:
            with Path(file).open("a") as out:
                out.write("".join(f"{line}\n" for line in sorted(lines)))


_OBJECT: Final = re.compile(
    r"""'|"|--\w|\[\w|\w\.\w|/|\w:\S|^\S*: |\w: """  # a value, option, key, file, URL, place
    r"|^[^:;]+? (=|is|are|has|have|needs?|cannot|can|does|do|stores?|drives|exceed|differ|must|"
    r"failed|found|fails|changes)\b"  # or a sentence about it
)


def broken_rules(*, kind: str, text: str, subject: str, place: str) -> Iterator[str]:
    """The rules that a text breaks. ``subject``: the class of an error, the object of a notice."""
    if not subject or (kind == "error" and not _OBJECT.search(text)):
        yield "names no object"
    if "\n" in text:
        yield "has a line break"
    if (length := len(_FOLDERS.sub("", text))) > CHARACTERS_MAX:
        yield f"has {length} characters, without folders"


def _place() -> str | None:
    """Return the file and line of the code that made the text; None if a test made it."""
    frame = sys._getframe(3)
    while frame.f_code.co_filename == "<string>" and frame.f_back is not None:  # of a dataclass
        frame = frame.f_back
    file = frame.f_code.co_filename
    in_code = file.startswith((f"{ROOT}/companion/", f"{ROOT}/sitl_replay/"))
    return f"{file[len(ROOT) + 1 :]}:{frame.f_lineno}" if in_code else None


def collect() -> CollectedTexts:
    """Collect from now on, in this process."""
    found = CollectedTexts()
    made, noticed, rejected = UserError.__init__, Notice.__init__, Rejection.__init__

    def error(self: UserError, *args: object) -> None:
        made(self, *args)
        found.add(self, "error", str(self), type(self).__name__)

    def notice(self: Notice, **fields: Any) -> None:
        noticed(self, **fields)
        found.add(self, "notice", self.text, self.subject)

    def rejection(self: Rejection, **fields: Any) -> None:
        rejected(self, **fields)
        if self.detail:
            found.add(self, "detail", self.detail, str(self.reason))

    UserError.__init__ = error  # type: ignore[method-assign]
    Notice.__init__ = notice  # type: ignore[method-assign]
    Rejection.__init__ = rejection  # type: ignore[method-assign]
    return found
