"""Cursor on Target events on a link, and the TUNNEL frame that carries each inside the program.

MAVLink has no message for an event's content: an id of any length, errors in metres. Each event
is therefore carried in a TUNNEL with a vendor-specific payload type
(https://mavlink.io/en/messages/common.html#TUNNEL), and is recorded, replayed and displayed like
any frame. ``decode`` reads only those of ``SENDER``.

Peers send XML, one event after the other, or TAK's protocol, version 1: 0xbf, the length, a message
(a stream), or 0xbf 0x01 0xbf and a message (a datagram).
"""

import hashlib
import math
import re
import struct
from typing import Final

from companion.mavlink.wire.cot import OWN, CotEvent, from_protobuf, from_xml, varint
from companion.mavlink.wire.encode import Outgoing
from companion.mavlink.wire.foreign import ForeignSplitter, Items
from companion.values import (
    Accuracy,
    AltitudeDatum,
    Frame,
    Reason,
    Rejection,
    Report,
    Source,
    UavKind,
)

TUNNEL: Final = 385
SENDER: Final = Source(0, 25)  # sender of the frames: no system, MAV_COMP_ID_USER1
EVENT_MAX: Final = 16 << 10  # longest event, bytes; a longer one is garbage
_KIND: Final = 0xC07A
_EVENT = struct.Struct("<Qii6f")
_HEAD = struct.Struct("<HBBB")
_MAGIC: Final = 0xBF
_BEGIN: Final = re.compile(
    rb"<event[\s>]"
    rb"|\xbf(?:\x01\xbf|[\x00-\x7f]|[\x80-\xff][\x00-\x7f]|[\x80-\xff]{2}[\x00\x01]"
    rb"|[\x80-\xff]{0,2}\Z)"
)
"""Start of an event, or of a TAK message: 0xbf and a length of at most ``EVENT_MAX``, or nearly.

Other bytes are passed over here, at a thousandth of the time of a message.
"""
_END: Final = re.compile(rb"</event\s*>")
_NO_EVENT: Final = re.compile(
    rb"<\?xml[^<>]*\?>|\s"
)  # stops at the next <: else quadratic in these
_PLAIN: Final = re.compile(r"[A-Za-z0-9._-]{1,60}")


class CotSplitter(ForeignSplitter):
    """Converter of the events of one peer to frames."""

    sender = SENDER

    def _parse(self, t_ns: int, data: bytes) -> Items:
        data, at = self._pending + data, 0
        out: Items = []
        while True:
            begun = _BEGIN.search(data, at)
            if begun is None:
                keep = _partial_start_bytes(data, at)
                self._stray += _count_stray_bytes(data[at : len(data) - keep])
                at = len(data) - keep
                break
            self._stray += _count_stray_bytes(data[at : begun.start()])
            at = begun.start()
            is_tak = data[at] == _MAGIC
            end = _tak_end(data, at, self._is_end) if is_tak else _xml_end(data, at)
            if end is None and len(data) - at <= EVENT_MAX:
                break
            if end is None or end - at > EVENT_MAX:
                beyond = at + 1 if is_tak else end or len(data)
                self._stray += beyond - at
                at = beyond
                continue
            self._complete += 1
            out += self._event(t_ns, data[at:end])
            at = end
        self._pending = data[at:]
        return out

    def _event(self, t_ns: int, raw: bytes) -> Items:
        if self._is_skipped():
            return []
        try:
            event = _tak(raw) if raw[0] == _MAGIC else from_xml(raw)
        except (ValueError, OverflowError) as why:
            return self._refused(t_ns, Reason.MALFORMED, str(why)[:80])
        if event is None:
            return []
        unfit = _rejection_reason(event)
        if unfit:
            return self._refused(t_ns, Reason.UNKNOWN_MESSAGE, unfit)
        if event.hae_m is None:
            uav = UavKind.COT.uav(_name(event.uid))
            return [Rejection(t_ns=t_ns, source=uav, reason=Reason.NO_ALTITUDE)]
        return [self._frame(t_ns, _outgoing(event))]


def _rejection_reason(event: CotEvent) -> str:
    """Return why an event must be rejected; empty if it is usable."""
    if not event.is_aircraft:
        return "not an aircraft"
    if event.how.startswith("h"):
        return "position entered by hand"
    return "event of another companion service" if event.uid.startswith(OWN) else ""


def _count_stray_bytes(data: bytes) -> int:
    """Count the bytes between events, except XML declarations and white space."""
    return len(_NO_EVENT.sub(b"", data))


def _partial_start_bytes(data: bytes, at: int) -> int:
    """Count the bytes at the end that may start an event or a declaration."""
    opened = data.rfind(b"<", max(at, len(data) - 200))
    return 0 if opened < 0 or b">" in data[opened:] else len(data) - opened


def _xml_end(data: bytes, at: int) -> int | None:
    found = _END.search(data, at)
    return found.end() if found else None


def _tak_end(data: bytes, at: int, is_whole: bool) -> int | None:
    """Return the index after a TAK message; None if it is incomplete.

    A datagram has no length: its message extends to the end. ``is_whole``: nothing follows ``data``
    of what was received.
    """
    if data[at + 1 : at + 3] == b"\x01\xbf":
        return len(data) if is_whole else None
    if len(data) < at + 3:
        return None
    try:
        size, start = varint(data, at + 1)
    except ValueError:
        return None
    return start + size if start + size <= len(data) or size > EVENT_MAX else None


def _tak(raw: bytes) -> CotEvent | None:
    if raw[1:3] == b"\x01\xbf":
        return from_protobuf(raw[3:])
    return from_protobuf(raw[varint(raw, 1)[1] :])


def _name(uid: str) -> str:
    """Return an event's uid; a shortened one with a hash if it has unsuitable characters."""
    if _PLAIN.fullmatch(uid):
        return uid
    short = re.sub(r"[^A-Za-z0-9._-]", "_", uid)[:40]
    return f"{short}-{hashlib.sha256(uid.encode('utf-8', 'replace')).hexdigest()[:8]}"


def _outgoing(event: CotEvent) -> Outgoing:
    unknown = math.nan
    numbers = (event.hae_m, event.ce_m, event.le_m)
    motion = (event.course_deg, event.speed_mps, event.slope_deg)
    body = _EVENT.pack(
        event.time_ms,
        round(event.lat_deg * 1e7),
        round(event.lon_deg * 1e7),
        *(unknown if one is None else one for one in (*numbers, *motion)),
    ) + _name(event.uid).encode("ascii")
    head = _HEAD.pack(_KIND, 0, 0, len(body))
    return Outgoing(SENDER, TUNNEL, head + body.ljust(128, b"\0"))


def report(frame: Frame) -> Report | None:
    """Return the report in a TUNNEL of ``SENDER``; None for other frames. Raises ``ValueError``."""
    if frame.source != SENDER:
        return None
    payload = frame.payload.ljust(_HEAD.size + 128, b"\0")
    kind, _, _, size = _HEAD.unpack_from(payload)
    if kind != _KIND:
        return None
    body = payload[_HEAD.size : _HEAD.size + size]
    name = body[_EVENT.size :].decode("ascii", "replace")
    if not _PLAIN.fullmatch(name):
        raise ValueError("invalid uid")
    time_ms, lat, lon, *numbers = _EVENT.unpack_from(body)
    hae_m, ce_m, le_m, course_deg, speed_mps, slope_deg = (
        None if math.isnan(one) else one for one in numbers
    )
    if hae_m is None or abs(lat) > 900_000_000 or abs(lon) > 1_800_000_000:
        raise ValueError("position is missing or out of range")
    velocity = down = None
    if course_deg is not None and speed_mps is not None:
        course = math.radians(course_deg)
        velocity = (speed_mps * math.cos(course), speed_mps * math.sin(course))
        if slope_deg is not None:
            down = -speed_mps * math.tan(math.radians(slope_deg))
    return Report(
        t_ns=frame.t_ns,
        uav=UavKind.COT.uav(name),
        source=frame.source,
        lat_deg=lat * 1e-7,
        lon_deg=lon * 1e-7,
        alt_m=hae_m,
        alt_datum=AltitudeDatum.GEOMETRIC,
        relative_alt_m=None,
        velocity_ne_mps=velocity,
        velocity_down_mps=down,
        heading_deg=course_deg,
        boot_ms=time_ms & 0xFFFF_FFFF,
        tslc_s=None,
        accuracy=Accuracy(horizontal_m=ce_m, vertical_m=le_m),
    )
