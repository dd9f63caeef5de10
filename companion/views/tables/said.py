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
    Column(name="t_ns", kind=_INT, unit="ns", meaning="when, since 1970", of=lambda one: one.t_ns),
    Column(name="t_utc", kind=_TIME, unit="UTC", meaning="the same", of=lambda one: one.t_ns),
    Column(name="source", kind=_T, unit="", meaning="a UAV, a sender, a link or a log",
           of=lambda one: one.source),
    Column(name="reason", kind=_T, unit="",
           meaning="why, in the words of [troubleshooting](troubleshooting.md)",
           of=lambda one: one.reason),
    Column(name="count", kind=_INT, unit="", meaning="how many frames; of `garbage`, bytes",
           of=lambda one: one.count),
    Column(name="message", kind=_T, unit="",
           meaning="the MAVLink message; by its number where that has no name here", of=_message),
    Column(name="detail", kind=_T, unit="", meaning="more of that", of=lambda one: one.detail),
))

EVENTS: Final = Table("events", "a notice, or an assumption that reports refuted", (
    Column(name="t_ns", kind=_INT, unit="ns", meaning="when, since 1970", of=lambda one: one.t_ns),
    Column(name="t_utc", kind=_TIME, unit="UTC", meaning="the same", of=lambda one: one.t_ns),
    Column(name="kind", kind=_T, unit="", meaning=f"`{NOTICE}` or `{REFUTED}`",
           of=lambda one: NOTICE if isinstance(one, Notice) else REFUTED),
    Column(name="subject", kind=_T, unit="", meaning="whom it is about", of=_subject),
    Column(name="severity", kind=_T, unit="", meaning="of a notice: `info`, `warning` or `error`",
           of=lambda one: _of(one, "severity")),
    Column(name="text", kind=_T, unit="", meaning="what the notice says",
           of=lambda one: _of(one, "text")),
    Column(name="setting", kind=_T, unit="",
           meaning="the assumption that was refuted, in the unit of its setting",
           of=lambda one: _of(one, "setting")),
    Column(name="limit", kind=_N, unit="", meaning="what was assumed",
           of=lambda one: _of(one, "limit")),
    Column(name="proven", kind=_N, unit="", meaning="what was proven at least",
           of=lambda one: _of(one, "proven")),
    Column(name="raised_to", kind=_N, unit="", meaning="what is assumed from then on",
           of=lambda one: _of(one, "raised_to")),
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
