"""An Analog Devices CN0566 Phaser, by pyadi-iio: ``phaser:ip:phaser.local``.

Eight elements on two ADAR1000, receive only. Phase, gain and attenuator of every element are
written, then latched once: ``set_chan_phase``, ``set_chan_gain`` and ``set_all_gain`` of
``adi.CN0566`` latch at each call, and are not used. The Phaser's own calibration is not applied,
since the registers already include the service's. The map from elements to chips and channels is
that of ``adi.CN0566``, where elements count from 1. Never tested on hardware: the tests run
pyadi-iio's class on a mock of libiio.
"""

from contextlib import AbstractContextManager
from typing import Any, Final

from companion.node.drive.loop import Device, DeviceCommand, DeviceInput, SafeState, library_errors
from companion.values import IntArray, UserError
from companion.values.extras import needs

ELEMENTS: Final = 8
DEGREES: Final = 360 / 128
FULL_GAIN: Final = 127
RESTING: Final = {SafeState.BORESIGHT: (0, FULL_GAIN, 0), SafeState.MUTE: (0, 0, 1)}
"""Phase code, gain code and attenuator of every element in a safe state."""


class Phaser(Device):
    """Phaser as a device, at a libiio URI."""

    name = "a Phaser"
    takes = DeviceInput.REGISTERS

    def __init__(self, uri: str) -> None:
        self._uri = uri
        self._phaser: Any = None
        self._shown: dict[int, tuple[int, int, int]] = {}

    def open(self) -> None:
        """Connect to the Phaser and switch to receive. Raises ``UserError`` without pyadi-iio."""
        with needs("adi", "phaser", "phaser:", "libiio (Debian: apt install libiio0)"):
            from adi import CN0566
        with self._library_errors():
            self._phaser = CN0566(uri=self._uri)
            self._phaser.configure(device_mode="rx")
        self._shown = {}

    def apply(self, command: DeviceCommand) -> None:
        """Write the changed registers, and latch once."""
        assert command.registers is not None
        self._set(self.settings_of(command.registers))

    @staticmethod
    def settings_of(registers: IntArray) -> dict[int, tuple[int, int, int]]:
        """Return phase code, gain code and attenuator of each element. Raises ``UserError``."""
        rows = registers[:, 2:6].tolist()
        if sorted(element for element, *_ in rows) != list(range(ELEMENTS)):
            raise UserError(f"a Phaser has {ELEMENTS} elements, the array has {len(rows)}")
        return {element: (phase, gain, off) for element, phase, gain, off in rows}

    def rest(self, safe: SafeState) -> None:
        """Hold the state, point to boresight, or mute every element."""
        if safe is not SafeState.HOLD:
            self._set(dict.fromkeys(range(ELEMENTS), RESTING[safe]))

    def close(self) -> None:
        """Release the connection to the Phaser."""
        self._phaser = None

    def _set(self, wanted: dict[int, tuple[int, int, int]]) -> None:
        shown, self._shown = self._shown, {}  # unknown while it is written, and after a failure
        with self._library_errors():
            for element, (phase, gain, attenuated) in wanted.items():
                if shown.get(element) == (phase, gain, attenuated):
                    continue
                one = self._phaser.elements[element + 1]
                one.rx_phase = phase * DEGREES
                one.rx_gain = gain
                one.rx_attenuator = bool(attenuated)
            self._phaser.latch_rx_settings()
        self._shown = dict(wanted)

    def _library_errors(self) -> AbstractContextManager[None]:
        return library_errors(f"the Phaser at {self._uri}")
