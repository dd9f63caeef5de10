"""The error for a file that cannot be used."""

from companion.values import UserError


class LogError(UserError):
    """A file that cannot be used. The message is one line: the file, and the reason."""
