"""Tables of updates: the array, tracks and beams, ten times a second."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Final

from companion.recording.tables.columns import Table
from companion.tracking.geodesy import LocalFrame, Place
from companion.values import Beam, BeamSet, Carrier, Track, Update
from companion.values.described import Inline, Meaning


class _OfUpdate:
    """Times of an update's row: when it was computed, and when its beams are applied."""

    update: Update

    @property
    def t_ns(self) -> Annotated[int, Meaning("when the update was computed")]:
        return self.update.t_ns

    @property
    def valid_at_ns(self) -> Annotated[int, Meaning("when its beams are applied")]:
        return self.update.beams.valid_at_ns


@dataclass(frozen=True)
class UpdateRow(_OfUpdate):
    """Update, with the local frame's origin and, if known, the carrier's position."""

    update: Update
    carrier_place: Annotated[Place | None, Inline(prefix="carrier_")]
    origin: Annotated[Place | None, Inline(prefix="origin_")]

    @property
    def unfit(self) -> Annotated[str | None, Meaning("why there are no beams at all")]:
        return self.update.unfit

    @property
    def tracks(self) -> Annotated[int, Meaning("UAVs that are targets of beams")]:
        return len(self.update.tracks)

    @property
    def beams(self) -> Annotated[int, Meaning("UAVs with a beam")]:
        return len(self.update.beams.beams)

    @property
    def made(self) -> Annotated[BeamSet, Inline(omit=("t_ns", "valid_at_ns"))]:
        return self.update.beams

    @property
    def carrier(self) -> Annotated[Carrier | None, Inline(prefix="carrier_")]:
        return self.update.carrier


@dataclass(frozen=True, kw_only=True)
class TrackRow(_OfUpdate):
    """Track at an update with its position, as a table row."""

    update: Update
    track: Annotated[Track, Inline(omit=("valid_at_ns",))]
    place: Annotated[Place, Inline()]
    left_out: Annotated[str | None, Meaning("why it has no beam; null: it has one")]


@dataclass(frozen=True)
class BeamRow(_OfUpdate):
    """Beam at an update, as a table row."""

    update: Update
    beam: Annotated[Beam, Inline()]


def rows(update: Update, local: LocalFrame | None) -> Iterator[tuple[str, Any]]:
    """Yield the rows of an update, each with the name of its table."""
    carrier = None if update.carrier is None else update.carrier.position_ned_m
    origin = None if local is None else Place(*local.origin)
    place = None if local is None or carrier is None else local.place(*carrier.tolist())
    yield UPDATES.name, UpdateRow(update, place, origin)
    left_out = {out.uav: update.unfit or out.reason for out in update.beams.left_out}
    for track in update.tracks:
        assert local is not None  # it exists from the first report on
        there = local.place(*track.position_ned_m.tolist())
        yield (
            TRACKS.name,
            TrackRow(update=update, track=track, place=there, left_out=left_out.get(track.uav)),
        )
    for beam in update.beams.beams:
        yield BEAMS.name, BeamRow(update, beam)


UPDATES: Final = Table(
    name="updates", row_is="a beam update: the array and all beams together", row_class=UpdateRow
)
TRACKS: Final = Table(
    name="tracks",
    row_is="a UAV that is a target of beams, at an update, predicted to the time of its beam",
    row_class=TrackRow,
    former_names={
        "north_m": "position_north_m",
        "east_m": "position_east_m",
        "down_m": "position_down_m",
        "bound_horizontal_m": "horizontal_bound_m",
        "bound_vertical_m": "vertical_bound_m",
        "speed_limit_mps": "speed_max_mps",
        "acceleration_limit_mps2": "acceleration_max_mps2",
        "limit_source": "limits_source",
    },
)
BEAMS: Final = Table(name="beams", row_is="a beam at an update", row_class=BeamRow)
