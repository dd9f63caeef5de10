"""Budgets: how much a source may use per second, so that it takes nothing from the others."""

from dataclasses import dataclass, field


@dataclass(slots=True, kw_only=True)
class Budget:
    """Allowance of one source, as a token bucket.

    A source may use ``per_s`` units each second, and saves at most ``most`` units. What a unit is
    (bytes, items, seconds of work) is the caller's choice. Time is an argument, in seconds of a
    clock that never goes back.
    """

    per_s: float
    most: float
    left: float = field(init=False)
    last_s: float = field(init=False, default=-float("inf"))

    def __post_init__(self) -> None:
        self.left = self.most

    def spend(self, amount: float, now_s: float) -> bool:
        """Use ``amount`` units if they are left, and return whether they were."""
        if now_s > self.last_s:
            self.left = min(self.most, self.left + (now_s - self.last_s) * self.per_s)
            self.last_s = now_s
        if amount > self.left:
            return False
        self.left -= amount
        return True

    def has(self, amount: float, now_s: float) -> bool:
        """Return whether ``amount`` units are left."""
        self.spend(0.0, now_s)
        return amount <= self.left

    def charge(self, amount: float) -> None:
        """Use units that were needed, also if fewer were left: the source then waits for them."""
        self.left -= amount
