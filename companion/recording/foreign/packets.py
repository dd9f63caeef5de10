"""Packets of a network capture: pcap, pcapng; Ethernet and similar links; IPv4, IPv6; UDP, TCP.

Formats: draft-ietf-opsawg-pcap, draft-ietf-opsawg-pcapng; link types by
https://www.tcpdump.org/linktypes.html. Truncated packets return their available part or nothing,
fragments their size; no length in a packet is trusted.
"""

import os
import struct
from collections.abc import Iterator
from typing import IO, Final, NamedTuple

PCAP: Final = {
    b"\xd4\xc3\xb2\xa1": ("<", 1_000),
    b"\xa1\xb2\xc3\xd4": (">", 1_000),
    b"\x4d\x3c\xb2\xa1": ("<", 1),
    b"\xa1\xb2\x3c\x4d": (">", 1),
}
"""First bytes of a pcap file, with its byte order and the nanoseconds per unit of its stamps."""
PCAPNG: Final = b"\x0a\x0d\x0d\x0a"
_LARGEST: Final = 1 << 18
"""Limit on a packet or block, bytes: what tcpdump captures of a packet.

Segments may have more than 64 kB where the network card splits them (BIG TCP).
"""
_INTERFACES_MAX: Final = 1024
_SECTION, _INTERFACE, _SIMPLE, _ENHANCED = 0x0A0D0D0A, 1, 3, 6
_NANOSECONDS_OPTION: Final = 9
_ETHERTYPES: Final = frozenset((0x0800, 0x86DD))
_VLANS: Final = frozenset((0x8100, 0x88A8, 0x9100))
_UDP: Final = 17
_TCP: Final = 6
_V6_EXTENSIONS: Final = frozenset((0, 43, 60))
_V6_FRAGMENT: Final = 44


class Packet(NamedTuple):
    """Captured packet: time, ns since 1970; link type; captured bytes."""

    t_ns: int
    link_type: int
    data: bytes


class Fragment(NamedTuple):
    """Fragment of an IP packet, which is not put together with the others; bytes of its payload."""

    size_bytes: int


class Segment(NamedTuple):
    """Payload of a packet with its flow, and for TCP its sequence number."""

    flow: str
    payload: bytes
    tcp_seq: int | None
    tcp_syn: bool


class Skipped(NamedTuple):
    """Bytes of a capture that are not packets."""

    size_bytes: int


# --- the file -------------------------------------------------------------------------------------


def packets(file: IO[bytes]) -> Iterator[Packet | Skipped]:
    """Yield the packets of a capture in the order of the file, up to the first invalid one."""
    head = file.read(4)
    if head == PCAPNG:
        yield from _blocks(file)
    elif head in PCAP:
        yield from _records(file, *PCAP[head])


def _records(file: IO[bytes], order: str, unit_ns: int) -> Iterator[Packet | Skipped]:
    head = file.read(20)
    if len(head) < 20:
        return
    link_type = struct.unpack(f"{order}I", head[16:20])[0] & 0xFFFF
    record = struct.Struct(f"{order}4I")
    while len(head := file.read(record.size)) == record.size:
        seconds, part, length, _ = record.unpack(head)
        if length > _LARGEST:
            yield Skipped(record.size + _skip_rest(file))
            return
        data = file.read(length)
        yield Packet(seconds * 1_000_000_000 + part * unit_ns, link_type, data)
    if head:
        yield Skipped(len(head))


def _skip_rest(file: IO[bytes]) -> int:
    at = file.tell()
    return file.seek(0, os.SEEK_END) - at


class _Interface(NamedTuple):
    """Interface of a pcapng file: link type, unit of time, and time offset."""

    link_type: int
    numerator_ns: int
    denominator: int
    offset_ns: int


def _blocks(file: IO[bytes]) -> Iterator[Packet | Skipped]:
    order = "<"
    interfaces: list[_Interface] = []
    head = PCAPNG + file.read(4)
    last_ns = 0
    while len(head) == 8:
        if head[:4] == PCAPNG:  # a section has its own byte order and interfaces
            magic = file.read(4)
            order = ">" if magic == b"\x1a\x2b\x3c\x4d" else "<"
            interfaces = []
        kind, length = struct.unpack(f"{order}2I", head)
        taken = 12 if kind == _SECTION else 8
        if not taken + 4 <= length <= _LARGEST:
            yield Skipped(taken + _skip_rest(file))
            return
        body = file.read(length - taken)
        if len(body) < length - taken:
            yield Skipped(taken + len(body))
            return
        if kind == _INTERFACE and len(body) >= 12 and len(interfaces) < _INTERFACES_MAX:
            interfaces.append(_interface(body[:-4], order))
        elif kind in (_ENHANCED, _SIMPLE):
            packet = _packet(kind, body[:-4], order, interfaces, last_ns)
            if packet is not None:
                last_ns = packet.t_ns
                yield packet
        head = file.read(8)
    if head:
        yield Skipped(len(head))


def _interface(body: bytes, order: str) -> _Interface:
    (link_type,) = struct.unpack_from(f"{order}H", body)
    numerator_ns, denominator, offset_ns, at = 1_000, 1, 0, 8
    while at + 4 <= len(body):
        code, size = struct.unpack_from(f"{order}2H", body, at)
        value = body[at + 4 : at + 4 + size]
        if code == _NANOSECONDS_OPTION and value:
            finer = value[0] & 0x7F
            unit = 2**finer if value[0] & 0x80 else 10 ** min(finer, 18)
            numerator_ns, denominator = 1_000_000_000, unit
        elif code == 14 and len(value) == 8:
            offset_ns = struct.unpack(f"{order}q", value)[0] * 1_000_000_000
        at += 4 + size + -size % 4
    return _Interface(
        link_type=link_type, numerator_ns=numerator_ns, denominator=denominator, offset_ns=offset_ns
    )


def _packet(
    kind: int, body: bytes, order: str, interfaces: list[_Interface], last_ns: int
) -> Packet | None:
    if kind == _SIMPLE:  # without a time: that of the previous packet is used
        return Packet(last_ns, interfaces[0].link_type, body[4:]) if interfaces else None
    if len(body) < 20:
        return None
    number, high, low, length, _ = struct.unpack_from(f"{order}5I", body)
    if number >= len(interfaces):
        return None
    at = interfaces[number]
    t_ns = (high << 32 | low) * at.numerator_ns // at.denominator + at.offset_ns
    return Packet(t_ns, at.link_type, body[20 : 20 + length])


# --- contents of a packet -------------------------------------------------------------------------


def segment(packet: Packet) -> Segment | Fragment | None:
    """Return the UDP or TCP payload of a packet, or its fragment; None for anything else."""
    data, at = packet.data, _network(packet)
    if at is None or at >= len(data):
        return None
    version = data[at] >> 4
    if version == 4:
        return _v4(data, at)
    return _v6(data, at) if version == 6 else None


def _network(packet: Packet) -> int | None:
    """Return the offset of the IP header, by link type; None for other packets."""
    data, kind = packet.data, packet.link_type
    match kind:
        case 1:  # Ethernet
            at = 12
            while int.from_bytes(data[at : at + 2], "big") in _VLANS:
                at += 4
            return at + 2 if int.from_bytes(data[at : at + 2], "big") in _ETHERTYPES else None
        case 0 | 108:  # BSD loopback: an address family
            return 4
        case 12 | 14 | 101 | 228 | 229:  # raw IP
            return 0
        case 113:  # Linux cooked capture
            return 16 if int.from_bytes(data[14:16], "big") in _ETHERTYPES else None
        case 276:  # Linux cooked capture, version 2
            return 20 if int.from_bytes(data[0:2], "big") in _ETHERTYPES else None
    return None


def _v4(data: bytes, at: int) -> Segment | Fragment | None:
    if len(data) < at + 20:
        return None
    header = (data[at] & 0x0F) * 4
    length = int.from_bytes(data[at + 2 : at + 4], "big")
    fragment = int.from_bytes(data[at + 6 : at + 8], "big") & 0x3FFF
    if header < 20:
        return None
    if fragment:
        return Fragment(max(0, min(length, len(data) - at) - header))
    end = at + length if header <= length else len(data)  # 0: set later by the network card
    source, target = (".".join(map(str, data[at + n : at + n + 4])) for n in (12, 16))
    return _transport(data[:end], at + header, data[at + 9], source, target)


def _v6(data: bytes, at: int) -> Segment | Fragment | None:
    if len(data) < at + 40:
        return None
    length, following = int.from_bytes(data[at + 4 : at + 6], "big"), data[at + 6]
    end = at + 40 + length if length else len(data)
    source, target = (f"[{data[at + n : at + n + 16].hex(':', 2)}]" for n in (8, 24))
    at += 40
    while following in _V6_EXTENSIONS and at + 8 <= len(data):
        following, at = data[at], at + 8 + data[at + 1] * 8
    if following == _V6_FRAGMENT:
        return Fragment(max(0, min(end, len(data)) - at - 8))
    return _transport(data[:end], at, following, source, target)


def _transport(data: bytes, at: int, kind: int, source: str, target: str) -> Segment | None:
    if kind == _UDP and len(data) >= at + 8:
        ports = struct.unpack_from(">2H", data, at)
        length = int.from_bytes(data[at + 4 : at + 6], "big")
        end = at + length if length >= 8 else len(data)
        return Segment(
            flow=_flow("udp", source, target, ports),
            payload=data[at + 8 : end],
            tcp_seq=None,
            tcp_syn=False,
        )
    if kind == _TCP and len(data) >= at + 20:
        ports = struct.unpack_from(">2H", data, at)
        seq = int.from_bytes(data[at + 4 : at + 8], "big")
        begin = at + (data[at + 12] >> 4) * 4
        syn = bool(data[at + 13] & 0x02)
        return Segment(
            flow=_flow("tcp", source, target, ports), payload=data[begin:], tcp_seq=seq, tcp_syn=syn
        )
    return None


def _flow(kind: str, source: str, target: str, ports: tuple[int, ...]) -> str:
    return f"{kind}:{source}:{ports[0]}>{target}:{ports[1]}"
