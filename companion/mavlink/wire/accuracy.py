"""Accuracy codes of aircraft, converted to the accuracies that a GNSS receiver states.

NACp, NACv and GVA of ADS-B (RTCA DO-260B, 2.2.3.2.7.2.7, 2.2.3.2.6.1.5, 2.2.3.2.7.2.8) and the
accuracies of Remote ID (ASTM F3411-22a, ASD-STAN prEN 4709-002; MAV_ODID_HOR_ACC and the others of
https://mavlink.io/en/messages/common.html) each denote a limit that holds 95 % of errors. 0 is
"unknown, or worse than all of these"; undefined codes count as unknown.
"""

import math
from typing import Final

from companion.values import Accuracy

OF_95: Final = math.sqrt(math.log(1 - 0.68) / math.log(1 - 0.95))
"""Ratio of the radius of 68 % of errors to the radius of 95 %, in a plane (Rayleigh): 0.617.

Along a line it is 0.507; the larger ratio is used for heights too.
"""
_NM_M: Final = 1852.0
_NACP_M: Final = (
    None,
    *(miles * _NM_M for miles in (10.0, 4.0, 2.0, 1.0, 0.5, 0.3, 0.1, 0.05)),
    *(30.0, 10.0, 3.0),
)
_HORIZONTAL_M: Final = (*_NACP_M, 1.0)
_VELOCITY_MPS: Final = (None, 10.0, 3.0, 1.0, 0.3)
_GVA_M: Final = (None, 150.0, 45.0)
_VERTICAL_M: Final = (*_GVA_M, 25.0, 10.0, 3.0, 1.0)


def adsb(nac_p: int, nac_v: int, gva: int, *, time_error_s: float = 0.0) -> Accuracy | None:
    """Convert NACp, NACv and GVA to accuracies, with an error of the time; None if all are 0."""
    known = Accuracy(
        horizontal_m=_of(_NACP_M, nac_p),
        vertical_m=_of(_GVA_M, gva),
        velocity_mps=_of(_VELOCITY_MPS, nac_v),
        time_s=time_error_s or None,
    )
    return known if any(known) else None


def remote_id(horizontal: int, vertical: int, speed: int) -> Accuracy:
    """Convert the accuracy codes of a Remote ID location."""
    return Accuracy(
        horizontal_m=_of(_HORIZONTAL_M, horizontal),
        vertical_m=_of(_VERTICAL_M, vertical),
        velocity_mps=_of(_VELOCITY_MPS, speed),
    )


def _of(table: tuple[float | None, ...], code: int) -> float | None:
    limit = table[code] if 0 <= code < len(table) else None
    return None if limit is None else OF_95 * limit
