"""Weights of the beams through which the array's receiver measures powers."""

from collections import deque
from typing import Final

from companion.beams.array.geometry import Array
from companion.beams.hardware.codebooks import Codebook
from companion.pipeline import assembly
from companion.settings.model import Settings
from companion.values import ComplexArray, Observation
from companion.values.budget import Budget

UPDATES_KEPT: Final = 32  # newest updates whose weights are kept
ENTRIES_KEPT: Final = 2**19
"""Limit on the weights that are kept, 8 MB; the newest update is kept whatever its size."""
POWERS_PER_S: Final = 20.0
"""Most observations of powers per second that are processed: each takes some milliseconds."""
POWERS_SAVED: Final = 20.0  # most that may arrive at once


class PowerBeams:
    """Weights of the codebook and of the newest updates, and the budget for their use.

    Updates are numbered from 0, as in records (``sequence``).
    """

    def __init__(self, settings: Settings, array: Array) -> None:
        self._settings = settings
        self._array = array
        self._codebook: Codebook | None = None
        self._updates: deque[tuple[int, ComplexArray]] = deque()
        self._entries = 0
        self._budget = Budget(per_s=POWERS_PER_S, most=POWERS_SAVED)

    def add_update(self, number: int, weights: ComplexArray) -> None:
        """Keep the weights (M, N) of a new update; drop old ones beyond the limits."""
        self._updates.append((number, weights))
        self._entries += weights.size
        while len(self._updates) > UPDATES_KEPT or (
            self._entries > ENTRIES_KEPT and len(self._updates) > 1
        ):
            self._entries -= self._updates.popleft()[1].size

    def has_room(self, now_ns: int) -> bool:
        """Spend the budget of one observation, and return whether it was left."""
        return self._budget.spend(1, now_ns * 1e-9)

    def weights(self, event: Observation) -> ComplexArray | str:
        """Return the weights (M, K) of an observation's beams, or why there are none."""
        if event.update is None:
            found = self._stored()
            name = "codebook"
        else:
            found = next((kept for n, kept in self._updates if n == event.update), None)
            name = f"update {event.update}"
        if found is None:
            return self._missing(event.update)
        beyond = [beam for beam in event.beams if beam >= found.shape[1]]
        if beyond:
            return f"beams: {name} has {found.shape[1]} beams, no index {beyond[0]}"
        return found[:, list(event.beams)]

    def _stored(self) -> ComplexArray | None:
        if self._codebook is None:
            self._codebook = assembly.codebook(self._settings, self._array)
        return None if self._codebook is None else self._codebook.weights

    def _missing(self, update: int | None) -> str:
        if update is None:
            return "beams: there is no codebook; set [codebook], or give the number of an update"
        if not self._updates:
            return f"update: {update} is unknown; there is no update yet"
        first, last = self._updates[0][0], self._updates[-1][0]
        return f"update: {update} is unknown; the weights of {first} to {last} are kept"
