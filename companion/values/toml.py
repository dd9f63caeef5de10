"""Parsing of untrusted TOML in bounded time and memory.

``tomllib`` needs time and memory quadratic in the number of parts of a key. For integers with
thousands of digits and for deep nesting it raises errors other than its own. Text that would cost
too much is rejected before it is parsed.
"""

import re
import tomllib
from typing import Any, Final

from companion.values.errors import UserError

LARGEST: Final = 1 << 20
"""Most TOML characters outside strings: settings with 4096 oriented elements need 3/4 of it."""
LARGEST_TEXT: Final = 1 << 25
"""Most TOML characters in all: the largest attachment of a recording, in bytes."""
_STRINGS: Final = re.compile(
    r""""{3}(?:[^"\\]++|\\.|"(?!""))*+(?:"{3,5}+)?|"""  # of several lines
    r"""'{3}(?:[^']++|'(?!''))*+(?:'{3,5}+)?|"""
    r""""(?:[^"\\\n]++|\\[^\n])*+"?|'[^'\n]*+'?|#[^\n]*+""",
    re.DOTALL,
)
"""Pattern of a TOML string or comment, at any position.

An unterminated string matches up to where TOML would stop. Possessive quantifiers prevent
backtracking.
"""
_DEEP: Final = re.compile(r"(?:\.[^.=,\n]*){16}")
"""Pattern of a key with more parts than any format that is read has."""


def read_toml(text: str, largest: int = LARGEST) -> dict[str, Any]:
    """Parse TOML text. Raises ``UserError`` if it is invalid, too large, or has a NUL character.

    ``largest`` is the limit on characters without strings and comments.
    """
    if not _is_readable(text, largest):
        raise UserError("TOML is too large or nested too deeply")
    try:
        found = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"not TOML: {error}") from error
    except RecursionError as error:
        raise UserError("TOML is too large or nested too deeply") from error
    except ValueError as error:  # Python's limit on the digits of an integer
        raise UserError("TOML has a number of thousands of digits") from error
    if _has_nul(found):
        raise UserError("TOML has a NUL character; remove it")
    return found


def _has_nul(value: object) -> bool:
    if isinstance(value, dict):
        return any(_has_nul(key) or _has_nul(one) for key, one in value.items())
    if isinstance(value, list):
        return any(map(_has_nul, value))
    return isinstance(value, str) and "\0" in value


def _is_readable(text: str, largest: int) -> bool:
    if len(text) > LARGEST_TEXT:
        return False
    bare = _STRINGS.sub('""', text, largest // 2 + 1)  # more strings exceed the limit as '""'
    return len(bare) <= largest and not _DEEP.search(bare)
