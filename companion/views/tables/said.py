"""The tables of what was refused, and of what the program said."""

from collections.abc import Iterator, Sequence
from typing import Any, Final

from companion.recording.tables.columns import Column, Kind, Table
from companion.tracking.geodesy import LocalFrame
from companion.values import Event, Frame, Notice, Output, Refuted, Rejection, Update
from companion.views.tables import reports, updates

NOTICE: Final = "notice"
REFUTED: Final = "refuted"


def rows(
    event: Event, outputs: Sequence[Output], local: LocalFrame | None
) -> Iterator[tuple[str, Any]]:
    """All rows that come of an event, in all tables, each with the name of its table."""
    if isinstance(event, Frame):
        heard = reports.heard(event, outputs)
        if heard is not None:
            yield reports.REPORTS.name, heard
    for output in outputs:
        match output:
            case Rejection():
                yield REJECTIONS.name, output
            case Notice() | Refuted():
                yield EVENTS.name, output
            case Update():
                yield from updates.rows(output, local)


def _message(refused: Rejection) -> str | None:
    if refused.msgid is None:
        return None
    from pymavlink.dialects.v20 import all as generated  # loaded where anything was refused

    known = generated.mavlink_map.get(refused.msgid)
    return str(refused.msgid) if known is None else str(known.msgname)


def _subject(said: Notice | Refuted) -> str:
    return said.subject if isinstance(said, Notice) else said.uav


def _of(said: Notice | Refuted, name: str) -> Any:
    return getattr(said, name, None)


_T, _N, _TIME, _INT = Kind.TEXT, Kind.NUMBER, Kind.TIME, Kind.INTEGER

# fmt: off
REJECTIONS: Final = Table("rejections", "something received that was not used, reports included", (
    Column("t_ns", _INT, "ns", "when, since 1970", lambda one: one.t_ns),
    Column("t_utc", _TIME, "UTC", "the same", lambda one: one.t_ns),
    Column("source", _T, "", "a UAV, a sender, a link or a log", lambda one: one.source),
    Column("reason", _T, "", "why, in the words of [troubleshooting](troubleshooting.md)",
           lambda one: one.reason),
    Column("count", _INT, "", "how many frames; of `garbage`, bytes", lambda one: one.count),
    Column("message", _T, "", "the MAVLink message; by its number where that has no name here",
           _message),
    Column("detail", _T, "", "more of that", lambda one: one.detail),
))

EVENTS: Final = Table("events", "a notice, or an assumption that reports refuted", (
    Column("t_ns", _INT, "ns", "when, since 1970", lambda one: one.t_ns),
    Column("t_utc", _TIME, "UTC", "the same", lambda one: one.t_ns),
    Column("kind", _T, "", f"`{NOTICE}` or `{REFUTED}`",
           lambda one: NOTICE if isinstance(one, Notice) else REFUTED),
    Column("subject", _T, "", "whom it is about", _subject),
    Column("severity", _T, "", "of a notice: `info`, `warning` or `error`",
           lambda one: _of(one, "severity")),
    Column("text", _T, "", "what the notice says", lambda one: _of(one, "text")),
    Column("setting", _T, "", "the assumption that was refuted, in the unit of its setting",
           lambda one: _of(one, "setting")),
    Column("limit", _N, "", "what was assumed", lambda one: _of(one, "limit")),
    Column("proven", _N, "", "what was proven at least", lambda one: _of(one, "proven")),
    Column("raised_to", _N, "", "what is assumed from then on", lambda one: _of(one, "raised_to")),
))
# fmt: on

TABLES: Final = (
    reports.REPORTS,
    updates.TRACKS,
    updates.BEAMS,
    updates.UPDATES,
    REJECTIONS,
    EVENTS,
)
"""All tables of an export."""
