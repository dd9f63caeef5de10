"""An event of Cursor on Target as XML, for others to read.

``ce`` and ``le`` are what is guaranteed of the error, which is more than the standard deviation
that the schema means (``cot``): who takes one for the other is on the safe side, and ``remarks``
say which it is.
"""

from datetime import UTC, datetime
from typing import Final, NamedTuple
from xml.sax.saxutils import escape, quoteattr

from companion.mavlink.wire.cot import OWN, UNKNOWN

KIND: Final = "a-u-A"  # something that flies, and of which nobody said whose it is
HOW: Final = "m-f"  # by a machine, from several reports


class CotPosition(NamedTuple):
    """Where an aircraft is, how far it may be off, and how it moves; None is unknown.

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
    """One event, valid from one Unix time to another."""
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
    """The id of the events of a UAV; companions know them by it, and do not take them in."""
    return OWN + uav.replace(":", ".")


def _time(t_ns: int) -> str:
    at = datetime.fromtimestamp(t_ns // 1_000_000 / 1e3, UTC)
    return at.isoformat(timespec="milliseconds").replace("+00:00", "Z")
