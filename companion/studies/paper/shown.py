"""What the paper's figures show and its settings are, held against what is made here.

Its text and captions are known, its curves are not: a figure is the same where text, caption and
settings decide what it shows, differs where a setting or a reading does, and what only its curves
would tell cannot be told. Everything is in our words.
"""

from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any, Final


class Likeness(StrEnum):
    """How a figure made here stands to the paper's."""

    SAME = "same"
    DIFFERS = "differs"
    UNTOLD = "cannot be told"


@dataclass(frozen=True, slots=True, kw_only=True)
class Figure:
    """A figure of the paper: its number, what it shows, and how ours stands to it and why."""

    number: int
    shows: str
    likeness: Likeness
    why: str


@dataclass(frozen=True, slots=True)
class Guess:
    """A setting that the paper does not give: what is taken here, and on what it bears."""

    setting: str
    taken: str
    bears_on: str


FIGURES: Final = (
    Figure(
        number=1,
        shows="the parts and how they are joined",
        likeness=Likeness.UNTOLD,
        why="a drawing without numbers",
    ),
    Figure(
        number=2,
        shows="actual and predicted paths, and coordinates of UAV 1, α = 0.5, at the three levels",
        likeness=Likeness.SAME,
        why="same circles, gust, gains and interval; where on its circle each begins, and over"
        " which span it is drawn, is not said. Ours shows the outermost UAV's coordinates",
    ),
    Figure(
        number=3,
        shows="unknown input of UAV 1, actual and estimated, and the error, α = 0.5, three levels",
        likeness=Likeness.SAME,
        why="same estimator (G = [B; 0]) and gains; the gust is read as printed, d/ΔT, which"
        " decides the size of everything in it",
    ),
    Figure(
        number=4,
        shows="the same at α = 0.5, 0.1 and 0.01, with one level for all",
        likeness=Likeness.DIFFERS,
        why="same α and level (μ ≤ 0.25 s²; the caption has μ = √γ for γ = √μ), but the gains that"
        " the paper's solver chose there are not given: ours are another solver's",
    ),
    Figure(
        number=5,
        shows="spectral efficiency of each UAV over time",
        likeness=Likeness.DIFFERS,
        why="power, noise, path loss and how efficiency follows from the SINR are not given, so the"
        " scale is ours. Ours is the mean of the UAVs, with weights that are regularised at mirror"
        " images, where the printed ones have no answer",
    ),
    Figure(
        number=6,
        shows="spectral efficiency of each UAV over its azimuth",
        likeness=Likeness.DIFFERS,
        why="as figure 5; and azimuth is told by both coordinates here, where arccos folds it",
    ),
    Figure(
        number=7,
        shows="pattern of the beamformer with 64 elements: in space, azimuth and elevation cuts,"
        " polar",
        likeness=Likeness.DIFFERS,
        why="a line of elements, as the steering vector says; its elevation cut needs an element"
        " or a second axis, of which nothing is said",
    ),
    Figure(
        number=8,
        shows="polar patterns at two instants, and with 128 elements",
        likeness=Likeness.UNTOLD,
        why="which instants is not said: ours are two at which no UAV is near another's mirror"
        " image",
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
        why="the instants, their depth and length, and all of the probing (waveform, cross section,"
        " threshold, tracker) are not given: ours is a baseline at its best and a mean over random"
        " blockages, by how many there are",
    ),
)

GUESSES: Final = (
    Guess("where each UAV begins (φ)", "a quarter turn apart", "all that is drawn; opposite UAVs"),
    Guess("duration", "170 reports, two turns", "means of rates"),
    Guess("the observer's beginning", "without error", "the first seconds of figures 2 to 4"),
    Guess("transmit power", "30 dBm, shared", "figures 5, 6 and 10"),
    Guess("noise figure", "7 dB over 50 MHz", "figures 5, 6 and 10"),
    Guess("path loss", "free space", "figures 5, 6 and 10"),
    Guess("spectral efficiency", "log2(1 + SINR)", "figures 5, 6 and 10"),
    Guess("rays beside the direct one", "none", "figures 5, 6 and 10"),
    Guess("size of the transform of the OFDM", "only its least, 234, is used", "the waveform"),
    Guess("blockages", "at random, 0.5 s long on average", "figure 10"),
    Guess("echo probing", "a baseline at its best", "figure 10"),
    Guess("elements' pattern", "isotropic", "figures 7 to 9"),
)


def as_json() -> dict[str, Any]:
    """Figures and guesses as JSON has them."""
    return {
        "figures": [asdict(one) for one in FIGURES],
        "guesses": [asdict(one) for one in GUESSES],
    }
