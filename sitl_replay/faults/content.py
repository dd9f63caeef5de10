"""Faults of senders: frames are rewritten, with a valid checksum. Pure.

Field offsets follow https://mavlink.io/en/messages/common.html in wire order
(https://mavlink.io/en/guide/serialization.html: largest first; trailing zeros of a MAVLink 2
payload are truncated). A frame that a fault does not change keeps its bytes. A rewritten frame
loses its signature, since there is no key to sign it again.
"""

import math
import random
import struct
from typing import Final

import pymap3d
from fastcrc import crc16

from companion.mavlink.wire.crc_extra import CRC_EXTRA
from companion.mavlink.wire.framing import MAGIC_V2, SIGNED
from sitl_replay.faults.asked import Sender

ATTITUDE: Final = 30
GLOBAL_POSITION_INT: Final = 33

# fmt: off
TIME_BOOT_MS_AT: Final[dict[int, int]] = {
    2: 8, 26: 0, 29: 0, 30: 0, 31: 0, 32: 0, 33: 0, 34: 0, 35: 0, 65: 0, 81: 0, 82: 0, 83: 0,
    84: 0, 85: 0, 86: 0, 87: 0, 89: 0, 116: 0, 129: 0, 132: 0, 137: 0, 143: 0, 251: 0, 252: 0,
    254: 0, 257: 0, 259: 0, 260: 0, 261: 0, 262: 0, 263: 8, 264: 24, 265: 0, 271: 0, 277: 0,
    280: 0, 281: 0, 283: 8, 285: 0, 376: 0, 11037: 0, 11038: 0, 11060: 0, 60040: 0, 60050: 0,
    60051: 0, 60052: 0, 60053: 0,
}
# fmt: on
"""Offset in the payload of ``time_boot_ms`` (ms since boot, 32 bits), by message id."""

_POSITION_AT: Final = 4
_POSITION: Final = struct.Struct("<iiii")  # lat, lon (degE7), alt, relative_alt (mm)
_VELOCITY_AT: Final = 20
_VELOCITY: Final = struct.Struct("<hh")  # vx, vy (cm/s)
_HEADING_AT: Final = 26  # hdg (cdeg)
_NO_HEADING: Final = 0xFFFF
_YAW_AT: Final = 12
_YAW: Final = struct.Struct("<f")  # yaw in ATTITUDE (rad)
_WRAP_MS: Final = 1 << 32


def msgid_of(raw: bytes) -> int:
    """Return the message id of a MAVLink 1 or 2 frame."""
    return int.from_bytes(raw[7:10], "little") if raw[0] == MAGIC_V2 else raw[5]


def sender_of(raw: bytes) -> Sender:
    """Return the sender of a MAVLink 1 or 2 frame."""
    return (raw[5], raw[6]) if raw[0] == MAGIC_V2 else (raw[3], raw[4])


def seq_of(raw: bytes) -> int:
    """Return the sequence number of a MAVLink 1 or 2 frame."""
    return raw[4] if raw[0] == MAGIC_V2 else raw[2]


def payload_of(raw: bytes, size: int) -> bytes:
    """Return the first ``size`` bytes of a payload, with the zeros that MAVLink 2 truncates.

    The result is shorter if the payload of a MAVLink 1 frame is.
    """
    if raw[0] != MAGIC_V2:
        return raw[6 : 6 + min(raw[1], size)]
    return raw[10 : 10 + raw[1]].ljust(size, b"\0")[:size]


def rewritten(raw: bytes, at: int = 0, field: bytes = b"", seq: int | None = None) -> bytes:
    """Return a frame with ``field`` at payload offset ``at``, and ``seq`` (None: unchanged).

    The checksum is recomputed and the signature removed. Returns the same frame if nothing changes,
    if the message is unknown (so that there is no checksum), or if a MAVLink 1 payload is too
    short.
    """
    stop = at + len(field)
    before, msgid = payload_of(raw, stop), msgid_of(raw)
    seq = seq_of(raw) if seq is None else seq
    unchanged = before[at:] == field and seq == seq_of(raw)
    if unchanged or len(before) < stop or msgid not in CRC_EXTRA:
        return raw
    if raw[0] == MAGIC_V2:
        payload = before[:at] + field + raw[10 + stop : 10 + raw[1]]
        payload = payload[:1] + payload[1:].rstrip(b"\0")  # the first byte is never truncated
        head = bytes([len(payload), raw[2] & ~SIGNED, raw[3], seq]) + raw[5:10]
    else:
        payload = before[:at] + field + raw[6 + stop : 6 + raw[1]]
        head = bytes([len(payload), seq]) + raw[3:6]
    checksum = crc16.mcrf4xx(head + payload + bytes([CRC_EXTRA[msgid]]))
    return raw[:1] + head + payload + checksum.to_bytes(2, "little")


def boot_ms_of(raw: bytes) -> int | None:
    """Return ``time_boot_ms`` of a frame; None if its message has no such field."""
    at = TIME_BOOT_MS_AT.get(msgid_of(raw))
    if at is None:
        return None
    field = payload_of(raw, at + 4)[at:]
    return int.from_bytes(field, "little") if len(field) == 4 else None


def with_boot_ms(raw: bytes, boot_ms: int) -> bytes:
    """Return a frame with another ``time_boot_ms``, modulo 2³²; the message must have the field."""
    return rewritten(
        raw, TIME_BOOT_MS_AT[msgid_of(raw)], (boot_ms % _WRAP_MS).to_bytes(4, "little")
    )


class Drift:
    """Fault that makes the boot clock fast by ``ppm`` parts per million (negative: slow)."""

    def __init__(self, ppm: float) -> None:
        self._ppm = ppm

    def __call__(self, t_s: float, raw: bytes) -> bytes:
        """Return the frame as sent at ``t_s`` with this fault."""
        boot_ms = boot_ms_of(raw)
        return (
            raw
            if boot_ms is None
            else with_boot_ms(raw, boot_ms + round(boot_ms * self._ppm / 1e6))
        )


class Reboot:
    """Fault that restarts every sender's boot clock and sequence numbers at 0, at ``at_s``.

    The time of the reboot on a sender's clock is computed from its first time stamp after ``at_s``,
    assuming no delay. A frame with an older time stamp belongs to the previous boot: its time stamp
    is kept.
    """

    def __init__(self, at_s: float) -> None:
        self._at_s = at_s
        self._first_seq: dict[Sender, int] = {}
        self._booted_ms: dict[Sender, int] = {}

    def __call__(self, t_s: float, raw: bytes) -> bytes:
        """Return the frame as sent at ``t_s`` with this fault."""
        if t_s < self._at_s:
            return raw
        sender, boot_ms = sender_of(raw), boot_ms_of(raw)
        seq = (seq_of(raw) - self._first_seq.setdefault(sender, seq_of(raw))) % 256
        raw = rewritten(raw, seq=seq)
        if boot_ms is None:
            return raw
        since_ms = round((t_s - self._at_s) * 1000)
        booted_ms = self._booted_ms.setdefault(sender, max(0, boot_ms - since_ms))
        return with_boot_ms(raw, boot_ms - booted_ms) if boot_ms >= booted_ms else raw


class Frozen:
    """Fault that repeats a sender's last GLOBAL_POSITION_INT from ``at_s`` for ``lasts_s``.

    Latitude, longitude and both altitudes are repeated; time stamps, velocity and heading are
    unchanged. If a sender has no report before ``at_s``, its first one after that is repeated.
    """

    def __init__(self, at_s: float, lasts_s: float) -> None:
        self._at_s = at_s
        self._end_s = at_s + lasts_s
        self._positions: dict[Sender, bytes] = {}

    def __call__(self, t_s: float, raw: bytes) -> bytes:
        """Return the frame as sent at ``t_s`` with this fault."""
        if t_s >= self._end_s or (position := _position_of(raw)) is None:
            return raw
        if t_s < self._at_s:
            self._positions[sender_of(raw)] = position
            return raw
        return rewritten(raw, _POSITION_AT, self._positions.setdefault(sender_of(raw), position))


class Glitch:
    """Fault that displaces ``reports`` positions of each sender by ``metres``, from ``at_s`` on.

    The offset is horizontal, in one direction per sender that depends on ``seed`` and the sender's
    ids; altitudes are unchanged.
    """

    def __init__(self, *, at_s: float, metres: float, reports: int, seed: str) -> None:
        self._at_s = at_s
        self._metres = metres
        self._reports = reports
        self._seed = seed
        self._done: dict[Sender, int] = {}

    def __call__(self, t_s: float, raw: bytes) -> bytes:
        """Return the frame as sent at ``t_s`` with this fault."""
        if t_s < self._at_s or (position := _position_of(raw)) is None:
            return raw
        sender = sender_of(raw)
        self._done[sender] = done = self._done.get(sender, 0) + 1
        if done > self._reports:
            return raw
        return rewritten(raw, _POSITION_AT, self._beside(position, sender))

    def _beside(self, position: bytes, sender: Sender) -> bytes:
        bearing_deg = random.Random(f"{self._seed} {sender}").uniform(0.0, 360.0)
        return moved(position, self._metres, bearing_deg)


class Spoof:
    """Fault that makes reports drift away at ``speed_mps`` towards ``course_deg`` from ``at_s`` on.

    Position and velocity agree, as in those of a receiver that follows a forged GNSS signal.
    Altitudes and headings are unchanged.
    """

    def __init__(self, at_s: float, speed_mps: float, course_deg: float) -> None:
        self._at_s = at_s
        self._speed_mps = speed_mps
        self._course_deg = course_deg

    def __call__(self, t_s: float, raw: bytes) -> bytes:
        """Return the frame as sent at ``t_s`` with this fault."""
        position = _position_of(raw)
        whole = payload_of(raw, _VELOCITY_AT + _VELOCITY.size)
        if t_s < self._at_s or position is None or len(whole) < _VELOCITY_AT + _VELOCITY.size:
            return raw
        course_rad = math.radians(self._course_deg)
        north_cmps, east_cmps = _VELOCITY.unpack(whole[_VELOCITY_AT:])
        north_cmps += 100.0 * self._speed_mps * math.cos(course_rad)
        east_cmps += 100.0 * self._speed_mps * math.sin(course_rad)
        metres = (t_s - self._at_s) * self._speed_mps
        raw = rewritten(raw, _POSITION_AT, moved(position, metres, self._course_deg))
        return rewritten(raw, _VELOCITY_AT, _VELOCITY.pack(_int16(north_cmps), _int16(east_cmps)))


class Compass:
    """Fault that turns reported headings by ``error_deg``, clockwise positive, from ``at_s`` on."""

    def __init__(self, error_deg: float, at_s: float) -> None:
        self._error_deg = error_deg
        self._at_s = at_s

    def __call__(self, t_s: float, raw: bytes) -> bytes:
        """Return the frame as sent at ``t_s`` with this fault."""
        if t_s < self._at_s:
            return raw
        if msgid_of(raw) == ATTITUDE and len(whole := payload_of(raw, _YAW_AT + 4)) == _YAW_AT + 4:
            (yaw_rad,) = _YAW.unpack(whole[_YAW_AT:])
            turned_rad = math.remainder(yaw_rad + math.radians(self._error_deg), math.tau)
            return rewritten(raw, _YAW_AT, _YAW.pack(turned_rad))
        if _position_of(raw) is None or len(whole := payload_of(raw, _HEADING_AT + 2)) < 28:
            return raw
        heading_cdeg = int.from_bytes(whole[_HEADING_AT:], "little")
        if heading_cdeg == _NO_HEADING:
            return raw
        turned_cdeg = round(heading_cdeg + 100.0 * self._error_deg) % 36_000
        return rewritten(raw, _HEADING_AT, turned_cdeg.to_bytes(2, "little"))


ContentFault = Drift | Reboot | Frozen | Glitch | Spoof | Compass


def moved(position: bytes, metres: float, course_deg: float) -> bytes:
    """Return the position fields of GLOBAL_POSITION_INT, moved horizontally."""
    lat_e7, lon_e7, *altitudes_mm = _POSITION.unpack(position)
    lat_deg, lon_deg, _ = pymap3d.aer2geodetic(
        course_deg, el=0.0, srange=metres, lat0=lat_e7 / 1e7, lon0=lon_e7 / 1e7, h0=0.0
    )
    return _POSITION.pack(round(lat_deg * 1e7), round(lon_deg * 1e7), *altitudes_mm)


def _int16(value: float) -> int:
    return max(-32_768, min(32_767, round(value)))


def _position_of(raw: bytes) -> bytes | None:
    if msgid_of(raw) != GLOBAL_POSITION_INT:
        return None
    field = payload_of(raw, _POSITION_AT + _POSITION.size)[_POSITION_AT:]
    return field if len(field) == _POSITION.size else None
