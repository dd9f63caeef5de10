"""Stand-ins of hardware: chips that hold their registers, and a libiio that notes what is written.

``in_process`` puts them in the place of ``spidev`` and ``iio``, for a process of its own; what was
written goes to a file.
"""

import atexit
import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

from companion.values import Severity

Written = list[tuple[str, str, str]]
"""Device, or channel of one; attribute; value."""


def into(texts: list[str]) -> Callable[[str, Severity], None]:
    """A drive's ``say``: the texts of its notices."""
    return lambda text, _severity: texts.append(text)


class Chip:
    """What an ADAR1000 would hold: registers as written, and what is loaded from them."""

    def __init__(self) -> None:
        self.registers: dict[int, int] = {}
        self.loads = 0
        self.radiates: list[tuple[int, int, int]] = []
        self.closed = False
        self.max_speed_hz = self.mode = 0

    def open(self, bus: int, number: int) -> None:
        if bus == 9:
            raise FileNotFoundError(2, "No such file or directory")
        CHIPS[bus, number] = self

    def xfer2(self, word: list[int]) -> list[int]:
        assert len(word) == 3
        assert word[0] & 0x80 == 0  # a write
        register = (word[0] & 0x1F) << 8 | word[1]
        self.address = word[0] >> 5 & 3
        self.registers[register] = word[2]
        if register == 0x28 and word[2] & 1:
            self.loads += 1
            kept = self.registers
            self.radiates = [
                (kept[0x10 + n], kept[0x14 + 2 * n], kept[0x15 + 2 * n]) for n in range(4)
            ]
        return [0, 0, 0]

    def close(self) -> None:
        self.closed = True


CHIPS: dict[tuple[int, int], Chip] = {}


def spidev_module() -> ModuleType:
    """The module ``spidev``, its lines chips in ``CHIPS``."""
    module: Any = ModuleType("spidev")
    module.SpiDev = Chip
    found: ModuleType = module
    return found


class Attribute:
    def __init__(self, log: Written, where: str, name: str, value: str) -> None:
        self._log, self._where, self._name, self._value = log, where, name, value

    @property
    def value(self) -> str:
        return self._value

    @value.setter
    def value(self, value: str) -> None:
        self._value = value
        self._log.append((self._where, self._name, value))


class Attributes(dict[str, Attribute]):
    """Attributes of a device or channel: all there are, each writable, and every write noted."""

    def __init__(self, log: Written, where: str) -> None:
        super().__init__()
        self._log, self._where = log, where

    def __missing__(self, name: str) -> Attribute:
        value = "disabled PFD" if name.endswith("_available") else "0"
        self[name] = Attribute(self._log, self._where, name, value)
        return self[name]


class IioDevice:
    def __init__(self, log: Written, name: str, label: str) -> None:
        self.name, self.label, self._log = name, label, log
        self.attrs = self.debug_attrs = Attributes(log, label or name)
        self.channels = [SimpleNamespace(id=f"voltage{n}", attrs={}) for n in range(8)]

    def find_channel(self, name: str, output: bool = False) -> Any:
        where = f"{self.label or self.name}/{'out' if output else 'in'}/{name}"
        return SimpleNamespace(id=name, attrs=Attributes(self._log, where), output=output)

    def reg_write(self, register: int, value: int) -> None:
        self._log.append((self.label, f"reg {register:#x}", str(value)))


CONTEXT: list[Any] = []


def iio_module(log: Written) -> ModuleType:
    """The module ``iio``, with the devices of a CN0566; what is written to them goes to ``log``."""
    names = [
        ("adf4159", ""),
        ("adar1000", "BEAM0"),
        ("adar1000", "BEAM1"),
        ("one-bit-adc-dac", ""),
        ("ad7291", ""),
    ]
    made = [IioDevice(log, *name) for name in names]
    context = SimpleNamespace(
        devices=made, find_device=lambda name: next((one for one in made if one.name == name), None)
    )
    CONTEXT[:] = [context]  # adi keeps the module that it was loaded with
    module: Any = ModuleType("iio")
    module.version = (0, 26, "recording")
    module.Context = lambda uri: CONTEXT[0]
    module.Device = IioDevice
    module.__getattr__ = lambda name: type(name, (), {})
    found: ModuleType = module
    return found


def in_process(path: str) -> None:
    """Put the stand-ins in their places; write at the end what they were told, as JSON."""
    log: Written = []
    sys.modules["spidev"], sys.modules["iio"] = spidev_module(), iio_module(log)
    try:
        import adi
        import adi.cn0566
    except ImportError:
        pass  # whoever needs it says so
    else:
        adi.cn0566.sleep = lambda _: None
        adi.one_bit_adc_dac = lambda uri: SimpleNamespace(gpio_muxout=0)
        adi.ad7291 = lambda uri: SimpleNamespace()

    def tell() -> None:
        chips = {f"{bus}.{n}": [chip.loads, chip.radiates] for (bus, n), chip in CHIPS.items()}
        Path(path).write_text(json.dumps({"iio": log, "chips": chips}))

    atexit.register(tell)
