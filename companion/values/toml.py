"""TOML that somebody else wrote, read in bounded time and memory.

Its reader takes the square of a key's parts, of both, and raises errors of other kinds than its own
for integers of thousands of digits and for deep nesting. What would cost so much is refused before.
"""

import re
import tomllib
from typing import Any, Final

from companion.values.errors import UserError

LARGEST: Final = 1 << 20
"""Most characters without their strings: 4096 elements that face apart take 3/4 in settings."""
LARGEST_TEXT: Final = 1 << 25
"""Most characters: as many bytes as an attachment of a recording may have."""
_STRINGS: Final = re.compile(
    r""""{3}(?:[^"\\]++|\\.|"(?!""))*+(?:"{3,5}+)?|"""  # of several lines
    r"""'{3}(?:[^']++|'(?!''))*+(?:'{3,5}+)?|"""
    r""""(?:[^"\\\n]++|\\[^\n])*+"?|'[^'\n]*+'?|#[^\n]*+""",
    re.DOTALL,
)
"""What TOML takes for a string or a comment, wherever it begins.

One that does not end is taken up to where it must: TOML goes no further than there, and what was
looked at once is not looked at again.
"""
_DEEP: Final = re.compile(r"(?:\.[^.=,\n]*){16}")
"""More parts in a key than anything that is read here has."""


def read_toml(text: str, largest: int = LARGEST) -> dict[str, Any]:
    """The keys of TOML text. Raises ``UserError`` for what is none, and for what is too much.

    ``largest`` is how many characters it may have without its strings and comments.
    """
    if not _is_readable(text, largest):
        raise UserError("TOML that is too large, or nested too deeply")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"not TOML: {error}") from error
    except RecursionError as error:
        raise UserError("TOML that is too large, or nested too deeply") from error
    except ValueError as error:  # Python's limit on the digits of an integer
        raise UserError("TOML with a number of thousands of digits") from error


def _is_readable(text: str, largest: int) -> bool:
    if len(text) > LARGEST_TEXT:
        return False
    bare = _STRINGS.sub('""', text, largest // 2 + 1)  # so many are too large by themselves
    return len(bare) <= largest and not _DEEP.search(bare)
