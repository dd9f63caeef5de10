"""Phased-array devices: their settings and limits.

Each device's comment states what is public, and what is not. Conventions: channels and elements are
numbered from 0 in values; a positive phase is a factor exp(+j phase), as in a steering vector; full
gain is 0 dB, and every beam has its strongest element there. See docs/field-notes.md 5.
"""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from companion.beams.hardware.quantise import Quadrature, Resolution, SettableStates, stepped
from companion.values import WeightFormat


class Beamformer(StrEnum):
    """Kind of phased-array hardware for which weights can be written."""

    ADAR1000 = WeightFormat.ADAR1000.value
    TMYTEK = WeightFormat.TMYTEK.value
    SIVERS = WeightFormat.SIVERS.value


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceLimits:
    """Limits of a phased-array device.

    off_boresight_rad  largest steering angle off boresight; None: not stated
    """

    elements: int | None  # number of elements; None: any
    beams: int  # number of beams that it stores
    off_boresight_rad: float | None
    gain_range_db: float  # range of its gain control


# --- Analog Devices ADAR1000 ------------------------------------------------------------------
#
# Data sheet: four channels a chip, 360 degrees of phase at 2.8 degrees, at least 31 dB of gain at
# 0.5 dB or finer, memory for 121 beam positions. Linux driver (iio/beamformer/adar1000): 128 phases
# of 2.8125 degrees, RAM positions 0 to 120, gain register bits 6-0 the VGA and bit 7 set to bypass
# the attenuator. Neither gives the law from gain code to dB. Assumed: amplitude proportional to
# the code (pyadi-iio scales codes by amplitude ratios when it calibrates a CN0566), an attenuator
# of 15 dB (other public firmware for the chip), and codes down to 20: 16 dB and 15 dB make
# the 31 dB of the data sheet, and the coarsest step is 0.43 dB, below its 0.5 dB. Code 0 with the
# attenuator is how pyadi-iio silences an element.

ADAR1000_PHASES: Final = 128
ADAR1000_CHANNELS: Final = 4
ADAR1000_ATTENUATOR: Final = 10 ** (-15 / 20)
ADAR1000_LOWEST_GAIN: Final = 20
_JOIN: Final = next(  # the loudest code with the attenuator that is below the lowest without
    code for code in range(127, 0, -1) if code * ADAR1000_ATTENUATOR < ADAR1000_LOWEST_GAIN
)
ADAR1000_GAINS: Final = (
    *((code, 0) for code in range(127, ADAR1000_LOWEST_GAIN - 1, -1)),
    *((code, 1) for code in range(_JOIN, ADAR1000_LOWEST_GAIN - 1, -1)),
    (0, 1),
)
"""Gain code and attenuator (1: inserted) of each gain level; the last level is off."""

# Vector modulator registers of phase codes 0 to 63: data sheet rev. B, tables 13 to 16, as the
# Linux driver has them. Bit 5 is the sign (1: positive), bits 4-0 the magnitude. Half a turn
# further both signs change; a magnitude of 0 keeps the sign bit set.
_VM_I: Final = bytes.fromhex(
    "3f3f3f3f3f3e3e3d3d3c3c3b3a3938373635343332302f2e2c2b2a2827252422"
    "210103040607080a0b0d0e0f1112131416171819191a1b1c1c1d1e1e1e1f1f1f"
)
_VM_Q: Final = bytes.fromhex(
    "202123242627282a2b2d2e2f303133343536373838393a3a3b3c3c3c3d3d3d3d"
    "3d3d3d3d3d3c3c3c3b3a3a393838373635343331302f2e2d2b2a282726242321"
)


def vector_modulator(phase_code: int) -> tuple[int, int]:
    """Return the I and Q register bytes of an ADAR1000 for a phase code of 0 to 127."""
    half_turn, code = divmod(phase_code, 64)
    i, q = _VM_I[code], _VM_Q[code]
    return (i ^ 0x20, q ^ 0x20 if q & 0x1F else q) if half_turn else (i, q)


# --- TMYTEK BBox ------------------------------------------------------------------------------
#
# TLKCore examples of the manufacturer: the columns and their meaning, 64 beams, theta 0 to 45 and
# phi 0 to 359 whole degrees, channels from 1 (16 of them in the 4 x 4 antenna kits, which state -45
# to 45 degrees), ch_sw 0 on and 1 off, ch_deg whole degrees, ch_db in half decibels. The possible
# gains of a unit are in its own calibration tables, which ``unit_gains`` reads. Theta is the angle
# off boresight and phi the angle about it, counted here from the array's right (y) towards up (-z);
# only theta matters to tables of channels.

TMYTEK_CHANNELS: Final = 16
TMYTEK_STEP_DB: Final = 0.5
TMYTEK_RANGE_DB: Final = 7.5  # gain range of the channels in the manufacturer's example
TMYTEK_SETTINGS: Final = stepped(360, TMYTEK_STEP_DB, TMYTEK_RANGE_DB, off=True)


class Mode(StrEnum):
    """Use of a TMYTEK unit: transmission or reception, with a separate table for each."""

    TX = "TX"
    RX = "RX"


# --- Sivers EVK (Eder) ------------------------------------------------------------------------
#
# The manufacturer's control scripts for the EVK: a table of 64 rows by 16 antennas, each word 6
# bits of Q above 6 bits of I, antenna 15 at the lowest address and first in the file. In the same
# scripts a path is silenced by 31 in both, and a circle is driven by 31 times cosine and sine plus
# 31: the codes are offset by 31 (0 is -31, 62 is +31, 63 is not used). No steering limit is stated.

SIVERS_ANTENNAS: Final = 16
SIVERS_ROWS: Final = 64
SIVERS_OFFSET: Final = 31

SETTINGS: Final[dict[Beamformer, SettableStates]] = {
    Beamformer.ADAR1000: Resolution(
        ADAR1000_PHASES,
        (
            *(
                code / 127 * (ADAR1000_ATTENUATOR if attenuated else 1.0)
                for code, attenuated in ADAR1000_GAINS
            ),
        ),
    ),
    Beamformer.TMYTEK: TMYTEK_SETTINGS,
    Beamformer.SIVERS: Quadrature(SIVERS_OFFSET),
}
"""Possible settings of one channel, for each device."""

LIMITS: Final = {
    Beamformer.ADAR1000: DeviceLimits(
        elements=None, beams=121, off_boresight_rad=None, gain_range_db=31.0
    ),
    Beamformer.TMYTEK: DeviceLimits(
        elements=TMYTEK_CHANNELS,
        beams=64,
        off_boresight_rad=math.radians(45),
        gain_range_db=TMYTEK_RANGE_DB,
    ),
    Beamformer.SIVERS: DeviceLimits(
        elements=SIVERS_ANTENNAS,
        beams=SIVERS_ROWS,
        off_boresight_rad=None,
        gain_range_db=20 * math.log10(SIVERS_OFFSET),
    ),
}
"""Limits of each device. An ADAR1000 array has as many chips as it needs."""
