"""Thinning of samples, as the length of a log is unlimited and memory is not."""

from collections.abc import Iterable, MutableSequence, Sequence
from typing import Final, Generic, TypeVar

SAMPLES_MAX: Final = 200_000
"""Limit on the samples of one kind kept from a log: more than an hour at 50 Hz."""

T = TypeVar("T")


class Thinned(Generic[T]):
    """Collection that keeps all items up to a limit, then every second, fourth and so on.

    ``kept`` is the sequence that stores them, empty at first.
    """

    __slots__ = ("_seen", "kept", "stride")

    def __init__(self, kept: MutableSequence[T]) -> None:
        self.kept = kept
        self.stride = 1
        self._seen = 0

    def add(self, one: T) -> None:
        """Add one item."""
        if self._seen % self.stride == 0:
            self._keep((one,))
        self._seen += 1

    def extend(self, some: Sequence[T]) -> None:
        """Add several items, in order."""
        self._keep(some[-self._seen % self.stride :: self.stride])
        self._seen += len(some)

    def _keep(self, some: Iterable[T]) -> None:
        self.kept.extend(some)
        while len(self.kept) > SAMPLES_MAX:
            del self.kept[1::2]
            self.stride *= 2
