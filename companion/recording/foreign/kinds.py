"""Detection of files by their first bytes: onboard logs, captures, unsupported files."""

from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from typing import Final, Literal

from companion.recording.foreign.packets import PCAP, PCAPNG

Piecewise = Literal["dataflash", "ulog", "capture"]
_PIECEWISE: Final[tuple[tuple[bytes, Piecewise], ...]] = (
    (b"\xa3\x95\x80", "dataflash"),
    (b"ULog\x01\x12\x35", "ulog"),
    *((magic, "capture") for magic in (*PCAP, PCAPNG)),
)
_KINDS: Final[tuple[tuple[bytes, str], ...]] = (
    (b"FMT, 128,", "a DataFlash log as text: give the original .bin"),
    (b"\x1f\x8b", "compressed with gzip: gunzip it first"),
    (b"\x28\xb5\x2f\xfd", "compressed with zstd: unzstd it first"),
    (b"\xfd7zXZ\x00", "compressed with xz: unxz it first"),
    (b"BZh", "compressed with bzip2: bunzip2 it first"),
    (b"PK\x03\x04", "a zip archive: unpack it first"),
    (b"#ROSBAG V2.0", "a ROS bag, which is not supported"),
    (b"SQLite format 3\x00", "a database, perhaps a ROS 2 bag, which is not supported"),
    (b"%PDF-", "a PDF document"),
    (b"\x89PNG", "a picture"),
    (b"\x7fELF", "a program"),
)
REPLACED: Final = "\ufffd"  # what stands for a byte that is not UTF-8
HEAD_BYTES: Final = max(len(magic) for magic, _ in _KINDS)


def read_piecewise(head: bytes) -> Piecewise | None:
    """Return the kind of an onboard log or capture with these first bytes; None if neither."""
    return next((kind for magic, kind in _PIECEWISE if head.startswith(magic)), None)


def named(head: bytes) -> str | None:
    """Return kind and remedy of an unsupported file with these first bytes; None if unknown."""
    return next((name for magic, name in _KINDS if head.startswith(magic)), None)


def is_utf_16(head: bytes) -> bool:
    """Return whether a file without a frame is text in UTF-16; FE begins a MAVLink 1 frame, too."""
    return head.startswith((BOM_UTF16_LE, BOM_UTF16_BE))


def looks_like_text(head: bytes) -> bool:
    """Return whether the first bytes of a file are text, such as a table or settings.

    A tenth of it may be letters of another encoding than UTF-8: a table needs only ASCII.
    """
    text = head.decode("utf-8-sig", errors="replace")
    return text.count(REPLACED) < 0.1 * len(text) and all(
        char.isprintable() or char in "\t\r\n" for char in text
    )
