"""The newest values of a series, in a list: an empty deque takes ten times its memory."""

from typing import Generic, TypeVar

T = TypeVar("T")


class Newest(list[T], Generic[T]):
    """The newest values of a series, oldest first, at most ``most``.

    For what exists for each of thousands of UAVs, and holds few values.
    """

    __slots__ = ("most",)

    def __init__(self, most: int) -> None:
        super().__init__()
        self.most = most

    def append(self, value: T) -> None:
        """Add a value, and drop the oldest one beyond the limit."""
        if len(self) >= self.most:
            del self[0]
        list.append(self, value)
