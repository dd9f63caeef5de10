"""Comparison of the paper's figures and settings with those of this study.

The paper's text and captions are available, its curves are not. A figure is the same if text,
caption and settings determine its content, and differs if a setting or a reading does. If only
the curves could decide, it cannot be told. All texts are paraphrased.
"""

from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any, Final


class Likeness(StrEnum):
    """Relation of this study's figure to the paper's."""

    SAME = "same"
    DIFFERS = "differs"
    UNTOLD = "cannot be told"


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """Figure of the paper: its number and content; how this study's figure differs, and why."""

    number: int
    shows: str
    likeness: Likeness
    why: str


@dataclass(frozen=True, slots=True)
class AssumedSetting:
    """Setting that the paper does not state: the value assumed here, and what it affects."""

    setting: str
    taken: str
    bears_on: str


FIGURES: Final = (
    Figure(
        number=1,
        shows="block diagram of the system",
        likeness=Likeness.UNTOLD,
        why="diagram without numbers",
    ),
    Figure(
        number=2,
        shows="actual and predicted paths, and coordinates of UAV 1, α = 0.5, at the three levels",
        likeness=Likeness.SAME,
        why="same circles, gust, gains and interval; initial phases and time span are not given."
        " Ours shows the coordinates of the outermost UAV",
    ),
    Figure(
        number=3,
        shows="unknown input of UAV 1, actual and estimated, and the error, α = 0.5, three levels",
        likeness=Likeness.SAME,
        why="same estimator (G = [B; 0]) and gains; the gust is read as printed, d/ΔT, which"
        " determines all magnitudes",
    ),
    Figure(
        number=4,
        shows="the same at α = 0.5, 0.1 and 0.01, with one level for all",
        likeness=Likeness.DIFFERS,
        why="same α and level (μ ≤ 0.25 s²; the caption has μ = √γ for γ = √μ), but the gains of"
        " the paper's solver are not given: ours come from another solver",
    ),
    Figure(
        number=5,
        shows="spectral efficiency of each UAV over time",
        likeness=Likeness.DIFFERS,
        why="power, noise, path loss and the formula of efficiency from SINR are not given, so the"
        " scale is ours. Ours is the mean of the UAVs, with weights regularised at mirror images,"
        " where the printed ones do not exist",
    ),
    Figure(
        number=6,
        shows="spectral efficiency of each UAV over its azimuth",
        likeness=Likeness.DIFFERS,
        why="as figure 5; azimuth comes from both coordinates here, while arccos folds it",
    ),
    Figure(
        number=7,
        shows="pattern of the beamformer with 64 elements: in space, azimuth and elevation cuts,"
        " polar",
        likeness=Likeness.DIFFERS,
        why="a line of elements, as in the steering vector; the elevation cut depends on an"
        " element pattern or a second axis, which is not given",
    ),
    Figure(
        number=8,
        shows="polar patterns at two instants, and with 128 elements",
        likeness=Likeness.UNTOLD,
        why="the instants are not given: at ours no UAV is near the mirror image of another",
    ),
    Figure(
        number=9,
        shows="azimuth and elevation cuts of figure 8",
        likeness=Likeness.UNTOLD,
        why="as figures 7 and 8",
    ),
    Figure(
        number=10,
        shows="mean spectral efficiency over time, against echo probing, with blockages at some"
        " instants",
        likeness=Likeness.DIFFERS,
        why="times, depth and length of blockages and all settings of the probing (waveform, cross"
        " section, threshold, tracker) are not given: ours is a favourable baseline and a mean"
        " over random blockages, by blockage rate",
    ),
)

GUESSES: Final = (
    AssumedSetting(
        "initial phase of each UAV (φ)", "a quarter turn apart", "all figures; opposite UAVs"
    ),
    AssumedSetting("duration", "170 reports, two turns", "means of rates"),
    AssumedSetting(
        "initial state of the observer", "without error", "first seconds of figures 2 to 4"
    ),
    AssumedSetting("transmit power", "30 dBm, shared", "figures 5, 6 and 10"),
    AssumedSetting("noise figure", "7 dB over 50 MHz", "figures 5, 6 and 10"),
    AssumedSetting("path loss", "free space", "figures 5, 6 and 10"),
    AssumedSetting("spectral efficiency", "log2(1 + SINR)", "figures 5, 6 and 10"),
    AssumedSetting("scattered rays", "none", "figures 5, 6 and 10"),
    AssumedSetting("size of the OFDM transform", "only its minimum, 234, is used", "the waveform"),
    AssumedSetting("blockages", "random, 0.5 s long on average", "figure 10"),
    AssumedSetting("echo probing", "a favourable baseline", "figure 10"),
    AssumedSetting("element pattern", "isotropic", "figures 7 to 9"),
)


def as_json() -> dict[str, Any]:
    """Return the figures and the assumed settings as JSON."""
    return {
        "figures": [asdict(one) for one in FIGURES],
        "guesses": [asdict(one) for one in GUESSES],
    }
