"""A GNU Radio block that sends the stream of each UAV with its newest beam.

    beams = Beams(["1:1", "2:1"], elements=8, port=9000)      # [records] udp = ["127.0.0.1:9000"]

Input n is for UAV n, output m for element m: y_m = sum_n w_nm x_n, with the weights of the service
(no conjugate). Each call of ``work`` reads the records that have arrived, and uses the newest for
all its samples. Nothing is sent for a UAV without a beam, and nothing at all if no record has
arrived for ``stale_s``. For GNU Radio 3.10; needs numpy, and nothing from the service.
"""

import socket
import struct
import time
import zlib

import numpy as np
from gnuradio import gr

HEADER = struct.Struct("<8s4IQ2q8I2IQ")
NAME_BYTES = 72


class Beams(gr.sync_block):
    """One input per UAV, one output per element."""

    def __init__(self, uavs, elements, port, host="127.0.0.1", stale_s=1.0):
        gr.sync_block.__init__(
            self, "UAV beams", [np.complex64] * len(uavs), [np.complex64] * elements
        )
        self._uavs = {uav.encode(): n for n, uav in enumerate(uavs)}
        self._stale_s = stale_s
        self._heard_s = -np.inf
        self._sequence = -1
        self._weights = np.zeros((elements, len(uavs)), np.complex64)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((host, port))
        self._socket.setblocking(False)

    def work(self, input_items, output_items):
        """Multiply the samples by the weights."""
        self._hear()
        if self._is_stale():
            self._weights[:] = 0
        sent = self._weights @ np.stack(input_items)
        for m, out in enumerate(output_items):
            out[:] = sent[m]
        return len(output_items[0])

    def stop(self):
        """Close the socket."""
        self._socket.close()
        return True

    def _is_stale(self):
        return time.monotonic() - self._heard_s > self._stale_s

    def _hear(self):
        while True:
            try:
                record = self._socket.recv(1 << 16)
            except BlockingIOError:
                return
            self._take(record)

    def _take(self, record):
        """Use a record; ignore invalid and late ones, and those of another array."""
        if len(record) < HEADER.size:
            return
        magic, version, size, crc, _, sequence, _, _, *rest = HEADER.unpack_from(record)
        elements, beams, _, _, kind, entry, beams_at, weights_at, *_ = rest
        if magic != b"UAVBEAMS" or version != 1 or kind != 1 or size != len(record):
            return
        if zlib.crc32(record[20:]) != crc or elements != len(self._weights):
            return
        if weights_at + 8 * beams * elements > size or beams_at + beams * entry > weights_at:
            return
        weights = np.frombuffer(record, "<c8", beams * elements, weights_at)
        is_late = sequence < self._sequence and not self._is_stale()  # not a restarted service
        if is_late or not np.isfinite(weights).all():
            return
        if sequence != self._sequence:  # one update may come in several records
            self._weights[:] = 0
        for n, column in enumerate(weights.reshape(beams, elements)):
            name = record[beams_at + n * entry :][:NAME_BYTES].rstrip(b"\0")
            if name in self._uavs:
                self._weights[:, self._uavs[name]] = column
        self._sequence, self._heard_s = sequence, time.monotonic()
