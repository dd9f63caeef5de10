"""Cursor on Target events as XML, for other programs.

``ce`` and ``le`` are guaranteed bounds, which exceed the standard deviation that the schema means
(``cot``). A reader that confuses the two errs on the safe side, and ``remarks`` state which it is.
"""

from datetime import UTC, datetime
from typing import Final, NamedTuple
from xml.sax.saxutils import escape, quoteattr

from companion.mavlink.wire.cot import OWN, UNKNOWN

KIND: Final = "a-u-A"  # airborne, affiliation unknown
HOW: Final = "m-f"  # machine-generated, fused from several reports


class CotPosition(NamedTuple):
    """Position of an aircraft, bounds on its error, and motion; None: unknown.

    ``ce_m`` and ``le_m`` bound the error in the plane and in height.
    """

    lat_deg: float
    lon_deg: float
    hae_m: float | None
    ce_m: float
    le_m: float | None
    course_deg: float | None = None
    speed_mps: float | None = None


def event(uav: str, at_ns: int, stale_ns: int, place: CotPosition, remarks: str) -> bytes:
    """Return one event as XML, valid from one Unix time to another."""
    at, stale = _time(at_ns), _time(stale_ns)
    hae, le = (UNKNOWN if one is None else one for one in (place.hae_m, place.le_m))
    track = ""
    if place.course_deg is not None and place.speed_mps is not None:
        track = f'<track course="{place.course_deg:.1f}" speed="{place.speed_mps:.2f}"/>'
    detail = f"<contact callsign={quoteattr(uav)}/>{track}<remarks>{escape(remarks)}</remarks>"
    return (
        f'<event version="2.0" uid={quoteattr(uid(uav))} type="{KIND}" how="{HOW}" time="{at}" '
        f'start="{at}" stale="{stale}"><point lat="{place.lat_deg:.7f}" lon="{place.lon_deg:.7f}" '
        f'hae="{hae:.1f}" ce="{place.ce_m:.1f}" le="{le:.1f}"/><detail>'
        f"{detail}</detail></event>\n"
    ).encode()


def uid(uav: str) -> str:
    """Return a UAV's event id, which companion services recognise and ignore."""
    return OWN + uav.replace(":", ".")


def _time(t_ns: int) -> str:
    at = datetime.fromtimestamp(t_ns // 1_000_000 / 1e3, UTC)
    return at.isoformat(timespec="milliseconds").replace("+00:00", "Z")
