"""Digest of the pipeline's outputs, to compare two runs."""

import hashlib
import struct
from collections.abc import Sequence
from typing import Final

from companion.values import Estimate, Update

_NUMBERS: Final = struct.Struct("<q4d")


class Digest:
    """SHA-256 over all estimates and weights, in order; and over the estimates alone.

    Weights depend on the order of sums and on instructions such as fused multiplication and
    addition, which differ between kinds of processors. Estimates and predictions do not.
    """

    def __init__(self) -> None:
        self._hash = hashlib.sha256()
        self._estimates = hashlib.sha256()

    def add(self, output: Estimate | Update) -> None:
        """Add one output to the digest: little-endian doubles and integers, names in UTF-8."""
        if isinstance(output, Estimate):
            fix = output.fix
            data = _estimate(fix.uav, fix.t_ns, output.position_ned_m, output.bound_m)
            self._hash.update(data)
            self._estimates.update(data)
            return
        tracks = b"".join(
            _estimate(track.uav, track.valid_at_ns, track.position_ned_m.tolist(), track.bound_m)
            for track in output.tracks
        )
        self._estimates.update(tracks)
        uavs = "\0".join(output.beams.uavs).encode()
        weights = output.beams.weights.astype("<c16", copy=False).tobytes()
        self._hash.update(b"".join((tracks, uavs, weights)))

    def hexdigest(self) -> str:
        """Return the digest so far, equal for equal events on processors of one kind."""
        return self._hash.hexdigest()

    def of_estimates(self) -> str:
        """Return the digest of estimates and predictions, equal on all processors."""
        return self._estimates.hexdigest()

    def both(self) -> dict[str, str]:
        """Return both digests so far, as summaries and recordings name them."""
        return {"digest": self.hexdigest(), "digest_estimates": self.of_estimates()}


def _estimate(uav: str, t_ns: int, position_ned_m: Sequence[float], bound_m: float) -> bytes:
    return uav.encode() + _NUMBERS.pack(t_ns, *position_ned_m, bound_m)
