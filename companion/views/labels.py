"""Names, units and meanings of the values in the API, from which the page takes its labels."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Final

from companion.mavlink.voice.rate_watch import RateState
from companion.values import Cause, Level, Method, Policy, Reason, Severity, TrackState
from companion.values.described import DescribedEnum, Meaning, members, unit
from companion.views.as_json import name_in_json
from companion.views.beam_state import BeamState
from companion.views.center_state import Center
from companion.views.fleet import Fleet, FleetNode, FleetUav, NodeState
from companion.views.health import LinkHealth
from companion.views.link_state import HeardLink, LinkReports
from companion.views.state import RecordingStatus, Status
from companion.views.uav_state import UavState

SHOWN: Final = (
    BeamState, Center, Fleet, FleetNode, FleetUav, HeardLink, LinkHealth, LinkReports,
    RecordingStatus, Status, UavState,
)  # fmt: skip
"""Classes whose values the page shows."""
ENUMERATIONS: Final[tuple[type[DescribedEnum], ...]] = (
    Cause, Level, Method, NodeState, Policy, RateState, Reason, Severity, TrackState,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Label:
    """Name, unit and meaning of one value."""

    label: Annotated[str, Meaning("label of the value on the page", example="Innovation")]
    unit: Annotated[str, Meaning("unit; empty without one", example="m")]
    meaning: Annotated[str, Meaning("what the value means")]


@dataclass(frozen=True, slots=True)
class Labels:
    """Names, units and meanings of values by class, and of enumerations by value."""

    values: Annotated[dict[str, dict[str, Label]], Meaning("by class and name of the value")]
    enumerations: Annotated[dict[str, dict[str, str]], Meaning("meanings by enumeration and value")]


def labels() -> Labels:
    """Return the answer of ``/v1/labels``."""
    values = {shown.__name__: dict(_labels(shown)) for shown in SHOWN}
    enumerations = {kind.__name__: {str(one): one.meaning for one in kind} for kind in ENUMERATIONS}
    return Labels(values, enumerations)


def _labels(shown: Any) -> Iterator[tuple[str, Label]]:
    for member in members(shown):
        if "api" in member.meaning.absent:
            continue
        name = name_in_json(member.name)
        measure = unit(name)
        stem = name.rpartition("_")[0] if measure else name
        label = member.meaning.label or stem.replace("_", " ").capitalize()
        yield name, Label(label, measure, member.meaning.text)
