"""Base class of errors that a user can cause, and the display of untrusted values."""

from typing import Final

SHOWN_MAX: Final = 50  # longest value that an error message shows, characters


class UserError(ValueError):
    """Mistake of the program's user; only its one-line message is shown.

    Any other exception is a defect of the program and is shown with its traceback.
    """


def shown(given: object) -> str:
    """Return the ``repr`` of a value for an error message, cut to ``SHOWN_MAX``."""
    try:
        text = repr(given)
    except ValueError:  # Python's limit on the digits of an integer
        return "a number of thousands of digits"
    return text if len(text) <= SHOWN_MAX else f"{text[:SHOWN_MAX]}…"


def printable(text: str) -> str:
    """Remove control characters, such as terminal escapes, from a text; keep line breaks."""
    return "".join(char for char in text if char.isprintable() or char == "\n")


def text_of(error: BaseException) -> str:
    """Return an exception's message; the name of its type if it is empty, or raises itself."""
    try:
        return str(error) or type(error).__name__
    except Exception:
        return type(error).__name__
