"""The base class of every error that a user can cause, and what others wrote as it is said."""

from typing import Final

SHOWN_MAX: Final = 200  # most characters of a value that an error repeats


class UserError(ValueError):
    """A mistake made by the user of the program.

    Its message is one line, and only that line is shown.

    Any other exception is a defect of the program and is shown with its traceback.
    """


def shown(given: object) -> str:
    """A value as an error says it."""
    try:
        text = repr(given)
    except ValueError:  # Python's limit on the digits of an integer
        return "a number of thousands of digits"
    return text if len(text) <= SHOWN_MAX else f"{text[:SHOWN_MAX]}…"


def printable(text: str) -> str:
    """A text without what a terminal takes for orders, such as escapes; its lines are kept."""
    return "".join(char for char in text if char.isprintable() or char == "\n")
