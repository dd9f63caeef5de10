"""Codes by which aircraft say how exact they are, as what a GNSS receiver would say.

NACp, NACv and GVA of ADS-B (RTCA DO-260B, 2.2.3.2.7.2.7, 2.2.3.2.6.1.5, 2.2.3.2.7.2.8) each name a
limit below which 95 % of errors are. 0 is "unknown, or worse than all of these"; a code without a
meaning tells nothing either.
"""

import math
from typing import Final

from companion.values import Accuracy

OF_95: Final = math.sqrt(math.log(1 - 0.68) / math.log(1 - 0.95))
"""Radius that holds 68 % of errors over that which holds 95 %, in a plane (Rayleigh): 0.617.

Along a line it is 0.507: the greater is taken for heights too.
"""
_NM_M: Final = 1852.0
_NACP_M: Final = (
    None,
    *(miles * _NM_M for miles in (10.0, 4.0, 2.0, 1.0, 0.5, 0.3, 0.1, 0.05)),
    *(30.0, 10.0, 3.0),
)
_VELOCITY_MPS: Final = (None, 10.0, 3.0, 1.0, 0.3)
_GVA_M: Final = (None, 150.0, 45.0)


def adsb(nac_p: int, nac_v: int, gva: int) -> Accuracy | None:
    """What NACp, NACv and GVA say; None where all are unknown."""
    return _accuracy(_of(_NACP_M, nac_p), _of(_GVA_M, gva), _of(_VELOCITY_MPS, nac_v))


def _of(table: tuple[float | None, ...], code: int) -> float | None:
    limit = table[code] if 0 <= code < len(table) else None
    return None if limit is None else OF_95 * limit


def _accuracy(
    horizontal_m: float | None, vertical_m: float | None, velocity_mps: float | None
) -> Accuracy | None:
    if horizontal_m is vertical_m is velocity_mps is None:
        return None
    return Accuracy(horizontal_m, vertical_m, velocity_mps)
