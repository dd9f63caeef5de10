"""The newest values of a series: an empty deque takes ten times the memory of a list."""

from array import array
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


def append_number(series: "array[float]", value: float, most: int) -> None:
    """Add a number to a series, and drop the oldest one beyond the limit.

    An array takes 8 bytes for a number, a list 32.
    """
    if len(series) >= most:
        del series[0]
    series.append(value)
