"""ULog files for tests, written as the format's document has it, and a flight in one."""

import struct

import numpy as np

HEADER = b"ULog\x01\x12\x35" + b"\x01" + (1).to_bytes(8, "little")


def message(kind: str, body: bytes) -> bytes:
    return struct.pack("<HB", len(body), ord(kind)) + body


class Written:
    """A ULog under construction, as the format's document has it."""

    def __init__(self) -> None:
        self._head = HEADER + message("B", bytes(40))
        self._samples: list[tuple[float, bytes]] = []
        self._topics = 0

    @property
    def data(self) -> bytes:
        """What is described first, and then the samples of all topics in order of time."""
        samples = sorted(self._samples, key=lambda sample: sample[0])
        return self._head + b"".join(sample for _, sample in samples)

    def parameter(self, name: str, value: int) -> None:
        key = f"int32_t {name}".encode()
        self._head += message("P", bytes([len(key)]) + key + struct.pack("<i", value))

    def topic(self, name: str, fields: str, layout: str, rows: list[tuple[float, ...]]) -> None:
        number, self._topics = self._topics, self._topics + 1
        self._head += message("F", f"{name}:{fields}".encode())
        self._head += message("A", struct.pack("<BH", 0, number) + name.encode())
        for row in rows:
            sample = message("D", struct.pack("<H" + layout, number, *row))
            self._samples.append((row[0], sample))


def flight(seconds: int = 4, rate_hz: int = 10, fix_type: int = 3) -> Written:
    """North at 12 m/s and climbing, with truth 3 m to the east of it."""
    made = Written()
    made.parameter("MAV_SYS_ID", 7)
    made.parameter("MAV_TYPE", 2)
    times = [1_000_000 + n * 1_000_000 // rate_hz for n in range(seconds * rate_hz)]
    north_deg = [47.0 + 12.0 * (t - 1_000_000) * 1e-6 / 111_195.0 for t in times]
    place = "uint64_t timestamp;double lat;double lon;float alt;uint8_t[4] _padding0;"
    rows = [(t, n, 8.0, 500.0 + t * 1e-6) for t, n in zip(times, north_deg, strict=True)]
    made.topic("vehicle_global_position", place, "Qddf", rows)
    aside = [(t, n, 8.0 + 3.0 / 75_834.0, 500.0) for t, n, *_ in rows]
    made.topic("vehicle_global_position_groundtruth", place, "Qddf", aside)
    local = "uint64_t timestamp;float vx;float vy;float vz;float heading;"
    made.topic(
        "vehicle_local_position", local, "Qffff", [(t + 20_000, 12, 0, -1, 0.5) for t in times]
    )
    made.topic(
        "vehicle_attitude",
        "uint64_t timestamp;float[4] q;",
        "Q4f",
        [(t, np.cos(0.25), 0, 0, np.sin(0.25)) for t in times],
    )
    utc_us = 1_700_000_000_000_000
    made.topic(
        "vehicle_gps_position",
        "uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;int32_t alt;float eph;"
        "float epv;float s_variance_m_s;float vel_m_s;float cog_rad;uint8_t fix_type;"
        "uint8_t satellites_used;",
        "QQiii5fBB",
        [
            (
                t,
                utc_us + t,
                round(n * 1e7),
                80_000_000,
                501_000,
                1.5,
                2.5,
                0.4,
                12.0,
                0.0,
                fix_type,
                11,
            )
            for t, n in zip(times, north_deg, strict=True)
        ],
    )
    return made
