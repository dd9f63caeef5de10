"""Files by their first bytes: logs of one vehicle, and what is no log, with what to do about it."""

from typing import Final, Literal

_PIECEWISE: Final[tuple[tuple[bytes, Literal["dataflash", "ulog"]], ...]] = (
    (b"\xa3\x95\x80", "dataflash"),
    (b"ULog\x01\x12\x35", "ulog"),
)
_KINDS: Final[tuple[tuple[bytes, str], ...]] = (
    (b"FMT, 128,", "a DataFlash log as text: give the .bin that it was made of"),
    (b"\xd4\xc3\xb2\xa1", "a pcap capture: take the MAVLink out of its packets first"),
    (b"\xa1\xb2\xc3\xd4", "a pcap capture: take the MAVLink out of its packets first"),
    (b"\x4d\x3c\xb2\xa1", "a pcap capture: take the MAVLink out of its packets first"),
    (b"\xa1\xb2\x3c\x4d", "a pcap capture: take the MAVLink out of its packets first"),
    (b"\x0a\x0d\x0d\x0a", "a pcapng capture: take the MAVLink out of its packets first"),
    (b"\x1f\x8b", "compressed with gzip: gunzip it first"),
    (b"\x28\xb5\x2f\xfd", "compressed with zstd: unzstd it first"),
    (b"\xfd7zXZ\x00", "compressed with xz: unxz it first"),
    (b"BZh", "compressed with bzip2: bunzip2 it first"),
    (b"PK\x03\x04", "a zip archive: unpack it first"),
    (b"#ROSBAG V2.0", "a ROS bag: it is not read"),
    (b"SQLite format 3\x00", "a database, perhaps a ROS 2 bag: it is not read"),
    (b"%PDF-", "a PDF document"),
    (b"\x89PNG", "a picture"),
    (b"\x7fELF", "a program"),
)
HEAD_BYTES: Final = max(len(magic) for magic, _ in _KINDS)


def read_piecewise(head: bytes) -> Literal["dataflash", "ulog"] | None:
    """The kind of a vehicle's own log that begins with these bytes; None if it is none."""
    return next((kind for magic, kind in _PIECEWISE if head.startswith(magic)), None)


def named(head: bytes) -> str | None:
    """What a file is that begins with these bytes, and what to do; None if nothing is known."""
    return next((name for magic, name in _KINDS if head.startswith(magic)), None)


def looks_like_text(head: bytes) -> bool:
    """Whether the first bytes of a file are text, such as a table or settings."""
    try:
        text = head.decode("utf-8")
    except UnicodeDecodeError as error:
        if error.start < len(head) - 3:
            return False
        text = head[: error.start].decode("utf-8")
    return bool(text) and all(char.isprintable() or char in "\t\r\n" for char in text)
