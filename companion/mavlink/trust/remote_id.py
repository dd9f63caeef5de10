"""Aircraft of Remote ID: the id behind each radio address, and its reports.

A broadcast sends the id of its sender in a separate message (Basic ID), at least every three
seconds; until then a position has no id and is not used. Addresses change and are reused: an id
holds while its address is received. A sender that represents several aircraft (System) has no
position of a single one.
"""

from collections import OrderedDict
from dataclasses import dataclass
from typing import Final

from companion.values import AltitudeDatum, Reason, Rejection, RemoteId, Report, Source, UavKind

NAMED_NS: Final = 60_000_000_000  # how long an id holds after the last message of its address
ADDRESSES_MAX: Final = 4096
"""Most radio addresses remembered; beyond it the one silent for longest is forgotten."""
DATUM_NS: Final = 10_000_000_000  # how long an aircraft keeps the datum of its heights


@dataclass(slots=True, kw_only=True)
class _AddressRecord:
    heard_ns: int
    uas_id: str | None = None
    id_kind: int | None = None
    aircraft: int = 1
    datum: AltitudeDatum | None = None
    placed_ns: int = 0


class RemoteIds:
    """State of each radio address, per receiver. ``merge`` takes messages in order of arrival."""

    def __init__(self) -> None:
        self._known: OrderedDict[tuple[Source, str], _AddressRecord] = OrderedDict()

    def merge(self, message: RemoteId) -> Report | Rejection | None:
        """Return the report that a message completes, under its aircraft's id; None if incomplete.

        Rejections and their reasons:

            NO_IDENTITY  the address has not sent the id of its aircraft yet
            NO_ALTITUDE  a position without a height, or with a height of another datum than before
            SHARED_ID    the sender represents several aircraft
        """
        known = self._learned(message)
        if message.report is None and not message.is_flat:
            return None
        if known.uas_id is None:
            return _rejected(message, UavKind.REMOTE_ID.uav(message.heard_as), Reason.NO_IDENTITY)
        uav = UavKind.REMOTE_ID.uav(known.uas_id)
        if known.aircraft > 1:
            detail = f"sender represents {known.aircraft} aircraft"
            return _rejected(message, uav, Reason.SHARED_ID, detail)
        report = message.report
        if report is None:
            return _rejected(message, uav, Reason.NO_ALTITUDE)
        fresh = message.t_ns - known.placed_ns <= DATUM_NS
        if known.datum not in (None, report.alt_datum) and fresh:
            return _rejected(message, uav, Reason.NO_ALTITUDE, f"datum was {known.datum} before")
        known.datum, known.placed_ns = report.alt_datum, message.t_ns
        return report._replace(uav=uav)

    def _learned(self, message: RemoteId) -> _AddressRecord:
        key = message.source, message.heard_as
        known = self._known.pop(key, None)
        if known is None or message.t_ns - known.heard_ns > NAMED_NS:
            known = _AddressRecord(heard_ns=message.t_ns)
        self._known[key] = known
        known.heard_ns = message.t_ns
        if message.id_kind is not None and message.id_kind <= (known.id_kind or message.id_kind):
            known.uas_id, known.id_kind = message.uas_id, message.id_kind
        if message.aircraft is not None:
            known.aircraft = message.aircraft
        if len(self._known) > ADDRESSES_MAX:
            self._known.popitem(last=False)
        return known


def _rejected(message: RemoteId, uav: str, reason: Reason, detail: str = "") -> Rejection:
    return Rejection(t_ns=message.t_ns, source=uav, reason=reason, detail=detail)
