"""Cut a stretch out of a DataFlash log, messages unchanged: LOG START END OUT.

START and END in seconds since boot, START included. Kept are the descriptions of all messages, and
of the others those that say who and where the vehicle is; SIM2 only beside a SIM, for the size. The
messages are found by pymavlink's DFReader, so that the cut owes nothing to the code that is tested
with it.
"""

import argparse
import sys
from pathlib import Path

from pymavlink.DFReader import DFReader_binary

KEPT = ("ATT", "GPA", "GPS", "POS", "RATE", "SIM", "SIM2", "XKF1", "XKF4")
IDENTITY = ("FRAME_CLASS", "MAV_SYSID", "Q_ENABLE", "SYSID_THISMAV")


def cut(log: Path, start_s: float, end_s: float) -> bytes:
    """The messages stamped from ``start_s`` up to ``end_s``."""
    kept = []
    reader = DFReader_binary(str(log))
    simulated = None
    while (message := reader.recv_msg()) is not None:
        kind = message.get_type()
        within = kind in KEPT and start_s <= message.TimeUS * 1e-6 < end_s
        if kind == "SIM":
            simulated = message.TimeUS
        if kind == "SIM2":
            within = within and message.TimeUS == simulated
        named = kind == "PARM" and message.Name in IDENTITY
        if kind in ("FMT", "VER") or named or within:
            kept.append(bytes(message.get_msgbuf()))
    return b"".join(kept)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("log", type=Path)
    parser.add_argument("start_s", type=float)
    parser.add_argument("end_s", type=float)
    parser.add_argument("out", type=Path)
    args = parser.parse_args()
    args.out.write_bytes(cut(args.log, args.start_s, args.end_s))
    return 0


if __name__ == "__main__":
    sys.exit(main())
