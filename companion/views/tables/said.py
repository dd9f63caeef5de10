"""Tables of rejections and of events."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Final

from companion.recording.tables.columns import Table
from companion.tracking.geodesy import LocalFrame
from companion.values import Event, Frame, Notice, Output, Refuted, Rejection, Update
from companion.values.described import Inline, Meaning
from companion.views.tables import reports, updates

NOTICE: Final = "notice"
REFUTED: Final = "refuted"


def rows(
    event: Event, outputs: Sequence[Output], local: LocalFrame | None
) -> Iterator[tuple[str, Any]]:
    """Yield all table rows that an event adds, each with the name of its table."""
    if isinstance(event, Frame):
        heard = reports.heard(event, outputs)
        if heard is not None:
            yield reports.REPORTS.name, heard
    for output in outputs:
        match output:
            case Rejection():
                yield REJECTIONS.name, RejectionRow(output)
            case Notice():
                yield EVENTS.name, EventRow(output, None)
            case Refuted():
                yield EVENTS.name, EventRow(None, output)
            case Update():
                yield from updates.rows(output, local)


@dataclass(frozen=True, slots=True)
class RejectionRow:
    """Rejection, with the name of the message."""

    rejection: Annotated[Rejection, Inline()]

    @property
    def message(
        self,
    ) -> Annotated[str | None, Meaning("name of the MAVLink message; its id where unknown")]:
        msgid = self.rejection.msgid
        if msgid is None:
            return None
        from pymavlink.dialects.v20 import all as generated  # loaded only if something was rejected

        known = generated.mavlink_map.get(msgid)
        return str(msgid) if known is None else str(known.msgname)


@dataclass(frozen=True, slots=True)
class EventRow:
    """Notice, or assumption that reports refuted."""

    notice: Annotated[Notice | None, Inline(omit=("t_ns", "subject"))]
    refuted: Annotated[Refuted | None, Inline(omit=("t_ns",))]

    @property
    def t_ns(self) -> Annotated[int, Meaning("time of the notice")]:
        return self._said.t_ns

    @property
    def kind(self) -> Annotated[str, Meaning(f"`{NOTICE}` or `{REFUTED}`")]:
        return NOTICE if self.notice else REFUTED

    @property
    def subject(self) -> Annotated[str, Meaning("UAV, link or part of the service")]:
        said = self._said
        return said.subject if isinstance(said, Notice) else said.uav

    @property
    def _said(self) -> Notice | Refuted:
        said = self.notice or self.refuted
        assert said is not None
        return said


REJECTIONS: Final = Table(
    name="rejections",
    row_is="something received that was not used, reports included",
    row_class=RejectionRow,
)
EVENTS: Final = Table(
    name="events", row_is="a notice, or an assumption that reports refuted", row_class=EventRow
)
TABLES: Final = (
    reports.REPORTS,
    updates.TRACKS,
    updates.BEAMS,
    updates.UPDATES,
    REJECTIONS,
    EVENTS,
)
"""All tables of an export."""
