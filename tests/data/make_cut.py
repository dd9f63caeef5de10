"""Cut a stretch out of a clean telemetry log, records unchanged: LOG START END OUT.

START and END in seconds since the first record's stamp, START included. The log is walked by its
headers alone, so that the cut owes nothing to the code that is tested with it; a log that cannot
be walked so is refused.
"""

import argparse
import struct
import sys
from collections.abc import Iterator
from pathlib import Path

STAMP = struct.Struct(">Q")


def records(log: bytes) -> Iterator[tuple[int, bytes]]:
    """Stamp in microseconds and whole record, stamp included, of each frame."""
    at = 0
    while at < len(log):
        head = log[at + STAMP.size : at + STAMP.size + 3]
        if len(head) < 3 or head[0] not in (0xFD, 0xFE):
            raise ValueError(f"no frame follows the stamp at byte {at}")
        v2 = head[0] == 0xFD
        size = STAMP.size + head[1] + (12 + 13 * (head[2] & 1) if v2 else 8)
        if at + size > len(log):
            raise ValueError(f"the record at byte {at} is cut short")
        yield STAMP.unpack_from(log, at)[0], log[at : at + size]
        at += size


def cut(log: bytes, start_s: float, end_s: float) -> bytes:
    """The records stamped from ``start_s`` up to ``end_s`` after the first one."""
    kept = []
    first_us = None
    for stamp_us, record in records(log):
        first_us = stamp_us if first_us is None else first_us
        if start_s <= (stamp_us - first_us) / 1e6 < end_s:
            kept.append(record)
    return b"".join(kept)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("log", type=Path)
    parser.add_argument("start_s", type=float)
    parser.add_argument("end_s", type=float)
    parser.add_argument("out", type=Path)
    args = parser.parse_args()
    try:
        args.out.write_bytes(cut(args.log.read_bytes(), args.start_s, args.end_s))
    except (OSError, ValueError) as error:
        print(f"{args.log}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
