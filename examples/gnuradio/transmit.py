"""A flowgraph with the block of ``uav_beams``: samples of UAVs in, samples of elements out.

    python3 transmit.py 9000 8 1:1 2:1 < streams.c64 > elements.c64

Both files are interleaved complex64: one sample per UAV in the given order, and one per element. To
transmit by a radio, replace the last two blocks by its sink.
"""

import os
import sys

from gnuradio import blocks, gr
from uav_beams import Beams


class Transmit(gr.top_block):
    """The flowgraph from one file descriptor to another."""

    def __init__(self, port, elements, uavs, source, sink):
        gr.top_block.__init__(self, "transmit")
        self.beams = Beams(uavs, elements, port)  # keeps the Python block alive
        read = blocks.file_descriptor_source(gr.sizeof_gr_complex, source)
        write = blocks.file_descriptor_sink(gr.sizeof_gr_complex, sink)
        apart = blocks.deinterleave(gr.sizeof_gr_complex)
        together = blocks.interleave(gr.sizeof_gr_complex)
        self.connect(read, apart)
        for n in range(len(uavs)):
            self.connect((apart, n), (self.beams, n))
        for m in range(elements):
            self.connect((self.beams, m), (together, m))
        self.connect(together, write)


if __name__ == "__main__":
    port, elements, *uavs = sys.argv[1:]
    samples = os.dup(1)
    os.dup2(2, 1)  # other output goes to standard error
    top = Transmit(int(port), int(elements), uavs, 0, samples)
    print("open", file=sys.stderr, flush=True)
    top.run()
