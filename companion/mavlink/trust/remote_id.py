"""Remote ID's aircraft: which one sends from a radio's address, and its reports.

A broadcast names its sender in a message of its own (Basic ID), at least every three seconds; until
then a position has no name and is not used. Addresses change, and are used by others later: a name
holds while the address is heard. A sender that says to stand for several aircraft (System) has no
position that is one's.
"""

from collections import OrderedDict
from dataclasses import dataclass, replace
from typing import Final

from companion.values import AltitudeDatum, Reason, Rejection, RemoteId, Report, Source, UavKind

NAMED_NS: Final = 60_000_000_000  # how long a name holds after its address was last heard
ADDRESSES_MAX: Final = 4096
"""Addresses remembered; beyond it the one not heard for longest is forgotten."""
DATUM_NS: Final = 10_000_000_000  # how long an aircraft keeps what its heights are measured from


@dataclass(slots=True, kw_only=True)
class _AddressRecord:
    heard_ns: int
    uas_id: str | None = None
    id_kind: int | None = None
    aircraft: int = 1
    datum: AltitudeDatum | None = None
    placed_ns: int = 0


class RemoteIds:
    """What is known of each address, for each receiver. ``merge`` takes messages as they arrive."""

    def __init__(self) -> None:
        self._known: OrderedDict[tuple[Source, str], _AddressRecord] = OrderedDict()

    def merge(self, message: RemoteId) -> Report | Rejection | None:
        """The report that a message completes, under its aircraft's name; None if it has none.

        Rejections and their reasons:

            NO_IDENTITY  the address has not sent the id of its aircraft yet
            NO_ALTITUDE  a position without a height, or with one of another datum than before
            SHARED_ID    it stands for several aircraft
        """
        known = self._learned(message)
        if message.report is None and not message.is_flat:
            return None
        if known.uas_id is None:
            return _rejected(message, UavKind.REMOTE_ID.uav(message.heard_as), Reason.NO_IDENTITY)
        uav = UavKind.REMOTE_ID.uav(known.uas_id)
        if known.aircraft > 1:
            detail = f"it stands for {known.aircraft} aircraft"
            return _rejected(message, uav, Reason.SHARED_ID, detail)
        report = message.report
        if report is None:
            return _rejected(message, uav, Reason.NO_ALTITUDE)
        fresh = message.t_ns - known.placed_ns <= DATUM_NS
        if known.datum not in (None, report.alt_datum) and fresh:
            return _rejected(message, uav, Reason.NO_ALTITUDE, f"{known.datum} before")
        known.datum, known.placed_ns = report.alt_datum, message.t_ns
        return replace(report, uav=uav)

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
