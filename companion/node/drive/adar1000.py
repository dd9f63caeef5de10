"""ADAR1000 chips on Linux's SPI: ``adar1000:0.0,0.1``.

Registers of the data sheet, as in the Linux driver (iio/beamformer/adar1000): a word of 24 bits, 0
to write, the chip's address, 13 bits of register, 8 of value; receive gains from 0x10, receive
vector modulators from 0x14 (alternately I and Q), 0x28 to load the written values (bit 0 for
receive). Chips that share a chip select differ by address: here the index of the chip in the table,
modulo 4. Never tested on hardware: the tests check the resulting register values.
"""

import contextlib
from typing import Any, Final

from companion.beams.hardware.devices import ADAR1000_CHANNELS, vector_modulator
from companion.node.drive.loop import (
    Device,
    DeviceCommand,
    DeviceError,
    DeviceInput,
    SafeState,
    library_errors,
)
from companion.values import IntArray, UserError
from companion.values.extras import needs

RX_GAIN: Final = 0x10
RX_MODULATOR: Final = 0x14
LOAD: Final = 0x28
LOAD_RX: Final = 0x01
BYPASSED: Final = 0x80  # bit of a gain register that bypasses the attenuator
FULL_GAIN: Final = BYPASSED | 127
CLOCK_HZ: Final = 10_000_000


class Chips(Device):
    """ADAR1000 chips by SPI bus and device number, in the order of the table's chips."""

    name = "an ADAR1000"
    takes = DeviceInput.REGISTERS

    def __init__(self, places: list[tuple[int, int]]) -> None:
        self._places = places
        self._lines: list[Any] = []

    def open(self) -> None:
        """Open the SPI devices. Raises ``UserError`` without spidev."""
        with needs("spidev", "spi", "adar1000:"):
            import spidev
        for bus, number in self._places:
            with library_errors(f"SPI {bus}.{number}"):
                line = spidev.SpiDev()
                line.open(bus, number)
                line.max_speed_hz, line.mode = CLOCK_HZ, 0
            self._lines.append(line)

    def apply(self, command: DeviceCommand) -> None:
        """Write gain, I and Q of every channel, then send one load pulse to each chip."""
        assert command.registers is not None
        self._write(command.registers)

    def rest(self, safe: SafeState) -> None:
        """Hold the state, point to boresight, or mute every channel."""
        if safe is SafeState.HOLD:
            return
        i, q = vector_modulator(0)
        gain = FULL_GAIN if safe is SafeState.BORESIGHT else 0
        self._send([[(gain, i, q)] * ADAR1000_CHANNELS for _ in self._places])

    def close(self) -> None:
        """Close the SPI devices."""
        lines, self._lines = self._lines, []
        for line in lines:
            with contextlib.suppress(DeviceError), library_errors("SPI"):  # one that was unplugged
                line.close()

    def _write(self, registers: IntArray) -> None:
        chips: list[list[tuple[int, int, int]]] = [[] for _ in self._places]
        if registers[:, 0].max() >= len(chips):
            needed = registers[:, 0].max() + 1
            raise UserError(
                f"adar1000: {len(chips)} chips given, the array needs {needed}; list all"
            )
        for chip, _, _, _, gain, attenuated, i, q in registers.tolist():
            chips[chip].append((gain | (0 if attenuated else BYPASSED), i, q))
        self._send(chips)

    def _send(self, chips: list[list[tuple[int, int, int]]]) -> None:
        """Write the registers of all chips first, then the load pulses close together."""
        with library_errors("SPI"):
            for place, (line, channels) in enumerate(zip(self._lines, chips, strict=True)):
                for number, (gain, i, q) in enumerate(channels):
                    self._put(line, place, RX_GAIN + number, gain)
                    self._put(line, place, RX_MODULATOR + 2 * number, i)
                    self._put(line, place, RX_MODULATOR + 2 * number + 1, q)
            for place, line in enumerate(self._lines):
                self._put(line, place, LOAD, LOAD_RX)

    def _put(self, line: Any, place: int, register: int, value: int) -> None:
        line.xfer2([(place % 4) << 5 | register >> 8, register & 0xFF, value])
