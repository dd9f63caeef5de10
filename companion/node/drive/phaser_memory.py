"""A CN0566 Phaser by its beam memory: ``phaser-memory:ip:phaser.local``.

The codebook is stored once, when the device is opened; an update then only selects the memory
position of each channel, and latches once. Two positions are reserved for the safe states. Channels
are selected one by one: ``common_mem_enable`` of ``adi.adar1000`` writes a wrong attribute. Never
tested on hardware: the tests run pyadi-iio's class on a mock of libiio.
"""

from collections.abc import Sequence
from typing import Final

from companion.node.drive.loop import DeviceCommand, DeviceInput, SafeState
from companion.node.drive.phaser import DEGREES, ELEMENTS, RESTING, Phaser
from companion.values import IntArray, UserError

POSITIONS: Final = 121  # beams that an ADAR1000 stores for reception
BEAMS_MAX: Final = POSITIONS - 2  # the last positions are those of the safe states
POSITION_OF: Final = {SafeState.BORESIGHT: POSITIONS - 2, SafeState.MUTE: POSITIONS - 1}


class PhaserMemory(Phaser):
    """Phaser as a device whose memory holds a codebook, as registers (8, 8) of each beam."""

    takes = DeviceInput.STORED

    def __init__(self, uri: str, codebook: Sequence[IntArray]) -> None:
        super().__init__(uri)
        if len(codebook) > BEAMS_MAX:
            raise UserError(f"a Phaser stores {BEAMS_MAX} beams, the codebook has {len(codebook)}")
        self._beams = [self.settings_of(registers) for registers in codebook]
        self._position: int | None = None

    def open(self) -> None:
        """Connect, store the codebook and switch the channels to the memory."""
        super().open()
        kept = dict(enumerate(self._beams))
        for safe, position in POSITION_OF.items():
            kept[position] = dict.fromkeys(range(ELEMENTS), RESTING[safe])
        with self._library_errors():
            for position, settings in kept.items():
                for element, (phase, gain, attenuated) in settings.items():
                    one = self._phaser.elements[element + 1]
                    one.save_rx_beam(position, bool(attenuated), gain, phase * DEGREES)
            for chip in self._phaser.devices.values():
                chip.beam_mem_enable = True
        self._position = None

    def apply(self, command: DeviceCommand) -> None:
        """Select a stored beam for all channels, and latch once."""
        assert command.stored is not None
        self._use(command.stored)

    def rest(self, safe: SafeState) -> None:
        """Hold the state, point to boresight, or mute every element."""
        if safe is not SafeState.HOLD:
            self._use(POSITION_OF[safe])

    def _use(self, position: int) -> None:
        selected, self._position = self._position, None  # unknown after a failure
        with self._library_errors():
            if position != selected:
                for element in range(ELEMENTS):
                    self._phaser.elements[element + 1].rx_beam_state = position
            self._phaser.latch_rx_settings()
        self._position = position
