"""A CN0566 Phaser by its beam memory: ``phaser-memory:ip:phaser.local``.                  [shell]

The codebook is stored once, at opening; an update then says no more than which position of the
memory each channel uses, and latches once. Two positions are kept for the safe states. Channels are
pointed one by one: ``common_mem_enable`` of ``adi.adar1000`` writes another attribute than its own.
It was never on the air: what is tested is its own class over attributes of a libiio that records.
"""

from collections.abc import Sequence
from typing import Final

from companion.node.drive.loop import DeviceCommand, DeviceError, DeviceInput, SafeState
from companion.node.drive.phaser import DEGREES, ELEMENTS, FULL_GAIN, Phaser
from companion.values import IntArray, UserError

POSITIONS: Final = 121  # beams that an ADAR1000 stores for reception
BORESIGHT: Final = POSITIONS - 2
MUTE: Final = POSITIONS - 1


class PhaserMemory(Phaser):
    """A Phaser whose memory holds a codebook, given as registers (8, 8) of each beam."""

    takes = DeviceInput.STORED

    def __init__(self, uri: str, codebook: Sequence[IntArray]) -> None:
        super().__init__(uri)
        if len(codebook) > BORESIGHT:
            raise UserError(f"a Phaser stores {BORESIGHT} beams, the codebook has {len(codebook)}")
        self._beams = [self.settings_of(registers) for registers in codebook]
        self._position: int | None = None

    def open(self) -> None:
        """Connect, store the codebook and point the channels to the memory."""
        super().open()
        kept = dict(enumerate(self._beams))
        kept[BORESIGHT] = dict.fromkeys(range(ELEMENTS), (0, FULL_GAIN, 0))
        kept[MUTE] = dict.fromkeys(range(ELEMENTS), (0, 0, 1))
        try:
            for position, settings in kept.items():
                for element, (phase, gain, attenuated) in settings.items():
                    one = self._phaser.elements[element + 1]
                    one.save_rx_beam(position, bool(attenuated), gain, phase * DEGREES)
            for chip in self._phaser.devices.values():
                chip.beam_mem_enable = True
        except OSError as error:
            raise DeviceError(f"the Phaser at {self._uri}: {error}") from error
        self._position = None

    def apply(self, command: DeviceCommand) -> None:
        """Point all channels to a beam, and latch once."""
        assert command.stored is not None
        self._use(command.stored)

    def rest(self, safe: SafeState) -> None:
        """Hold, look along boresight, or silence every element."""
        if safe is not SafeState.HOLD:
            self._use(BORESIGHT if safe is SafeState.BORESIGHT else MUTE)

    def _use(self, position: int) -> None:
        try:
            if position != self._position:
                for element in range(ELEMENTS):
                    self._phaser.elements[element + 1].rx_beam_state = position
            self._phaser.latch_rx_settings()
        except OSError as error:
            self._position = None
            raise DeviceError(f"the Phaser at {self._uri}: {error}") from error
        self._position = position
