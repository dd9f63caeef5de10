"""Target strings of a drive and their devices; a device's module is loaded on first use.

    rotctld:HOST:PORT       a rotator behind hamlib's rotctld
    gimbal:HOST:PORT:SYSID:COMPID
                            a gimbal, by MAVLink's gimbal manager over UDP
    gimbal-roi:HOST:PORT:SYSID:COMPID
                            the same, with positions instead of directions
    phaser:URI              an Analog Devices CN0566 (ip:phaser.local), by pyadi-iio
    phaser-memory:URI       the same by its beam memory, which contains the codebook
    adar1000:BUS.DEVICE...  ADAR1000 chips on Linux's SPI, in the order of the table's chips
    none:pointing           no device: a dry run prints the commands
    none:adar1000           the same with registers
    none:stored             the same with beams of the codebook

IPv6 hosts are in brackets.
"""

import difflib
import re
from collections.abc import Callable, Sequence
from typing import Final

from companion.node.drive.loop import Device, DeviceCommand, DeviceInput, SafeState
from companion.values import IntArray, Source, UserError
from companion.values.errors import shown

FORMS: Final = {
    "rotctld": "rotctld:HOST:PORT",
    "gimbal": "gimbal:HOST:PORT:SYSID:COMPID",
    "gimbal-roi": "gimbal-roi:HOST:PORT:SYSID:COMPID",
    "phaser": "phaser:URI, such as phaser:ip:phaser.local",
    "phaser-memory": "phaser-memory:URI",
    "adar1000": "adar1000:BUS.DEVICE[,...]",
    "none": "none:pointing, none:adar1000 or none:stored",
}
_GIMBAL: Final = re.compile(r"(.+):(\d{1,5}):(\d{1,3}):(\d{1,3})")


def device(
    target: str, say: Callable[[str], None], codebook: Callable[[], Sequence[IntArray]]
) -> Device:
    """Return the device of a target. Raises ``UserError``.

    say       prints the commands of a dry run
    codebook  returns the registers (M, 8) of each stored beam; called if they are needed
    """
    kind, _, where = target.partition(":")
    match kind:
        case "rotctld":
            host, _, port = where.rpartition(":")
            if _is_host(host) and port.isdecimal() and 0 < int(port) < 65536:
                from companion.node.drive.rotctld import Rotator

                return Rotator(host.strip("[]"), int(port))
        case "gimbal" | "gimbal-roi":
            found = _GIMBAL.fullmatch(where)
            numbers = [int(one) for one in found.groups()[1:]] if found else []
            if found and _is_host(found[1]) and 0 < numbers[0] < 65536 and max(numbers[1:]) < 256:
                from companion.node.drive.gimbal import Gimbal, RoiGimbal

                made = Gimbal if kind == "gimbal" else RoiGimbal
                return made(host=found[1].strip("[]"), port=numbers[0], target=Source(*numbers[1:]))
        case "phaser" if where:
            from companion.node.drive.phaser import Phaser

            return Phaser(where)
        case "phaser-memory" if where:
            from companion.node.drive.phaser_memory import PhaserMemory

            return PhaserMemory(where, codebook())
        case "adar1000" if re.fullmatch(r"\d{1,3}\.\d{1,3}(,\d{1,3}\.\d{1,3})*", where):
            from companion.node.drive.adar1000 import Chips

            places = [tuple(map(int, one.split("."))) for one in where.split(",")]
            return Chips([(bus, number) for bus, number in places])
        case "none" if where in tuple(DeviceInput):
            return DryRun(DeviceInput(where), say)
    if kind in FORMS:
        raise UserError(f"{shown(target)} is not {FORMS[kind]}")
    near = difflib.get_close_matches(kind, FORMS, 1)
    meant = f"; did you mean {FORMS[near[0]]}?" if near else ""
    known = ", ".join(f"{one}:" for one in FORMS)
    raise UserError(f"{shown(target)} is not a device; give one of {known}{meant}")


def _is_host(name: str) -> bool:
    """Return whether the resolver takes a name; others would be a defect of the thread."""
    try:
        name.encode("idna")
    except UnicodeError:
        return False
    return bool(name)


class DryRun(Device):
    """Device of a dry run: accepts and prints every command."""

    def __init__(self, takes: DeviceInput, say: Callable[[str], None]) -> None:
        self.takes = takes
        self._say = say

    def open(self) -> None:
        """Do nothing: there is no device."""

    def apply(self, shot: DeviceCommand) -> None:
        """Print the device command."""
        if shot.stored is not None:
            self._say(f"{shot.uav}: stored beam {shot.stored}")
            return
        if shot.registers is None:
            degrees = 57.29577951308232
            bearing, above = shot.bearing_rad * degrees, shot.above_rad * degrees
            self._say(f"{shot.uav}: bearing {bearing:.2f}, {above:.2f} above the horizon")
            return
        sets = [f"{one[2]}:{one[3]}/{one[4]}{'a' if one[5] else ''}" for one in shot.registers]
        self._say(f"{shot.uav}: element:phase/gain {' '.join(sets)}")

    def rest(self, safe: SafeState) -> None:
        """Print the device's safe state."""
        self._say(f"safe state: {safe}")

    def close(self) -> None:
        """Do nothing: there is no device."""
