"""Samples of UAVs in, samples of elements out: a flowgraph about the block of ``uav_beams``.

    python3 transmit.py 9000 8 1:1 2:1 < streams.c64 > elements.c64

Both are complex64 by turns, of UAVs in their order and of elements. Where a radio takes the
samples, its sink stands in the place of the last two blocks.
"""

import os
import sys

from gnuradio import blocks, gr
from uav_beams import Beams


class Transmit(gr.top_block):
    """The flowgraph from one file descriptor to another."""

    def __init__(self, port, elements, uavs, source, sink):
        gr.top_block.__init__(self, "transmit")
        self.beams = Beams(uavs, elements, port)  # a block in Python goes with its last reference
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
    os.dup2(2, 1)  # what is said beside goes where errors go
    top = Transmit(int(port), int(elements), uavs, 0, samples)
    print("open", file=sys.stderr, flush=True)
    top.run()
