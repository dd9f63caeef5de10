"""Error for a log file that cannot be used."""

from companion.values import UserError


class LogError(UserError):
    """Error of a log file that cannot be used. The message is one line: file and reason."""
