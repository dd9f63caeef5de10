"""State of the pipeline at one time of a log."""

from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Final

from companion.node.replay import log_events
from companion.pipeline.fold import Pipeline
from companion.recording import ends
from companion.recording.reader import utc_offset_ns
from companion.settings.model import Settings
from companion.values import Update, UserError, UtcNs, shown
from companion.views.as_json import rfc3339

PROGRESS_EVERY: Final = 20_000  # events between two calls of progress

ENDS_NS: Final = 60_000_000_000
"""Tolerance of a log's first and last time against its events, as stamps may step or jump."""


class MomentError(UserError):
    """Error of a requested time that is not in the log."""


def look(
    logs: Sequence[Path],
    settings: Settings,
    at: str,
    *,
    lead_s: float = 0.0,
    progress: Callable[[float], None] | None = None,
    latency_s: float = 0.0,
) -> tuple[Pipeline, Update]:
    """Return the pipeline after all events up to a time, and its beams at that time.

        logs      as for a replay
        settings  as for a replay
        at        seconds from the log's first event, or a date and time with zone (RFC 3339),
                  by the node's wall clock as it was last set in the log
        lead_s    time from ``at`` until the beams are applied
        progress  called occasionally with seconds of log
        latency_s as for a replay

    Raises ``MomentError`` for an invalid time, or one outside the log; ``LogError`` and
    ``ConfigError`` as for a replay.
    """
    span_ns, offset_ns = ends.span_ns(logs), utc_offset_ns(logs)
    if span_ns is not None:
        _require_within(at, span_ns, offset_ns)
    pipeline, at_ns, seen, t_ns = Pipeline(settings), None, 0, 0
    begins_ns = 0
    for event in log_events(logs, settings, latency_s):
        if at_ns is None:
            begins_ns, at_ns = event.t_ns, _time_ns(at, event.t_ns, offset_ns)
        if event.t_ns > at_ns:
            break
        pipeline.step(event)
        seen, t_ns = seen + 1, max(t_ns, event.t_ns)
        if progress and seen % PROGRESS_EVERY == 0:
            progress((t_ns - begins_ns) * 1e-9)
    else:
        if at_ns is None or at_ns > t_ns:
            raise _too_late(at, (begins_ns, t_ns), offset_ns)
    if at_ns < begins_ns:
        raise _too_early(at, begins_ns, offset_ns)
    pipeline.utc_offset_ns = offset_ns  # so that the answer has the time that was asked for
    return pipeline, pipeline.look(at_ns, lead_s)


def _require_within(at: str, span_ns: tuple[int, int], utc_offset_ns: int) -> None:
    """Reject a time far outside the ends of the logs, before they are read."""
    first_ns, last_ns = span_ns
    at_ns = _time_ns(at, first_ns, utc_offset_ns)
    if at_ns > last_ns + ENDS_NS:
        raise _too_late(at, span_ns, utc_offset_ns)
    if at_ns < first_ns - ENDS_NS:
        raise _too_early(at, first_ns, utc_offset_ns)


def _too_late(at: str, span_ns: tuple[int, int], utc_offset_ns: int) -> MomentError:
    begins_ns, ends_ns = span_ns
    start = rfc3339(UtcNs(begins_ns + utc_offset_ns))
    begins = "" if _seconds(at) is not None else f", from {start}"
    return MomentError(f"--at {at}: the log is {(ends_ns - begins_ns) * 1e-9:.1f} s long{begins}")


def _too_early(at: str, begins_ns: int, utc_offset_ns: int) -> MomentError:
    start = rfc3339(UtcNs(begins_ns + utc_offset_ns))
    begins = "later" if _seconds(at) is not None else f"at {start}"
    return MomentError(f"--at {at}: the log begins {begins}")


def _seconds(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _time_ns(text: str, begins_ns: int, utc_offset_ns: int) -> int:
    seconds = _seconds(text)
    try:
        if seconds is not None:
            return begins_ns + round(seconds * 1e9)
    except (ValueError, OverflowError):  # not a finite number
        pass
    try:
        then = datetime.fromisoformat(text)
    except ValueError as error:
        raise MomentError(
            f"--at {shown(text)}: neither seconds from the start nor a time such as"
            " 2026-01-01T12:00:00Z"
        ) from error
    if then.tzinfo is None:
        raise MomentError(f"--at {text}: time zone is missing; append Z for UTC")
    return round(then.timestamp() * 1e9) - utc_offset_ns
