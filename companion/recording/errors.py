"""The mistake of a user who gave a file that cannot be used."""

from companion.values import UserError


class LogError(UserError):
    """A file that cannot be used. The message is one line: the file, and why."""
