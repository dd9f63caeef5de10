"""MAVLink frames of simulated vehicles, as events: positions and attitudes, without latency."""

from typing import Any

import pymap3d
from pymavlink.dialects.v20 import all as dialect

from companion.values import Frame, Source

S = 1_000_000_000
START_NS = 1_760_000_000 * S
PLACE = (47.4, 8.55, 500.0)


def frame(t_ns: int, raw: bytes, link: str = "udp") -> Frame:
    msgid = raw[7] | raw[8] << 8 | raw[9] << 16
    return Frame(t_ns=t_ns, link=link, source=Source(raw[5], raw[6]), msgid=msgid, raw=raw)


def sent(t_s: float, source: str, message: Any, seq: int = 0, link: str = "udp") -> Frame:
    sysid, compid = Source.parse(source)
    sender = dialect.MAVLink(None, srcSystem=sysid, srcComponent=compid)
    sender.seq = seq
    return frame(START_NS + round(t_s * 1e9), bytes(message.pack(sender)), link)


def position(
    t_s: float,
    source: str,
    ned_m: tuple[float, float, float] = (0, 0, 0),
    velocity_mps: tuple[float, float, float] = (0, 0, 0),
    *,
    boot_s: float | None = None,
    seq: int = 0,
    link: str = "udp",
) -> Frame:
    """Return a GLOBAL_POSITION_INT at an offset from PLACE, without latency."""
    lat, lon, alt = pymap3d.ned2geodetic(*ned_m, *PLACE)
    message = dialect.MAVLink_global_position_int_message(
        round(1000 * (100 + t_s if boot_s is None else boot_s)),
        round(float(lat) * 1e7), round(float(lon) * 1e7), round(float(alt) * 1e3), 0,
        *(round(100 * v) for v in velocity_mps), 65535,
    )  # fmt: skip
    return sent(t_s, source, message, seq, link)


def attitude(t_s: float, source: str, *angles: float) -> Frame:
    rpy = angles or (0.0, 0.0, 0.0)
    message = dialect.MAVLink_attitude_message(round(1000 * (100 + t_s)), *rpy, 0.0, 0.0, 0.0)
    return sent(t_s, source, message)
