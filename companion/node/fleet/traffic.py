"""Rates of sent and received fleet messages."""


class Rate:
    """Data rate in bits per second, from the bytes between two calls of ``look``."""

    def __init__(self) -> None:
        self.bytes = 0
        self.bps = 0.0
        self._before: tuple[int, int] | None = None

    def look(self, now_ns: int) -> None:
        """Compute the data rate since the last call."""
        if self._before is not None and now_ns > self._before[0]:
            t_ns, had = self._before
            self.bps = 8e9 * (self.bytes - had) / (now_ns - t_ns)
        self._before = now_ns, self.bytes
