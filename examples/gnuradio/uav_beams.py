"""A GNU Radio block that sends each UAV's stream by its newest beam.

    beams = Beams(["1:1", "2:1"], elements=8, port=9000)      # [records] udp = ["127.0.0.1:9000"]

Stream n in is for UAV n; stream m out is for element m: y_m = sum_n w_nm x_n, as the service has
its weights (no conjugate). Each call of its work takes the records that have come, and uses the
newest for all of its samples. A UAV without a beam is silent, and so are all once no record has
come for ``stale_s``. For GNU Radio 3.10; needs numpy, and nothing of the service.
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
    """As many streams of samples in as UAVs, as many out as elements."""

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
        """Multiply what has come."""
        self._hear()
        if time.monotonic() - self._heard_s > self._stale_s:
            self._weights[:] = 0
        sent = self._weights @ np.stack(input_items)
        for m, out in enumerate(output_items):
            out[:] = sent[m]
        return len(output_items[0])

    def stop(self):
        """Let go of the port."""
        self._socket.close()
        return True

    def _hear(self):
        while True:
            try:
                record = self._socket.recv(1 << 16)
            except BlockingIOError:
                return
            self._take(record)

    def _take(self, record):
        """Use a record; what is none, or is for another array, is left alone."""
        if len(record) < HEADER.size:
            return
        magic, version, size, crc, _, sequence, _, _, *rest = HEADER.unpack_from(record)
        elements, beams, _, _, kind, entry, beams_at, weights_at, *_ = rest
        if magic != b"UAVBEAMS" or version != 1 or kind != 1 or size != len(record):
            return
        if zlib.crc32(record[20:]) != crc or elements != len(self._weights):
            return
        if sequence != self._sequence:  # one update may come in several records
            self._weights[:] = 0
        weights = np.frombuffer(record, "<c8", beams * elements, weights_at)
        for n, column in enumerate(weights.reshape(beams, elements)):
            name = record[beams_at + n * entry :][:NAME_BYTES].rstrip(b"\0")
            if name in self._uavs:
                self._weights[:, self._uavs[name]] = column
        self._sequence, self._heard_s = sequence, time.monotonic()
