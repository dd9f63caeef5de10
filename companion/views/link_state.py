"""Links and requested message rates as the API shows them."""

from typing import Any

import numpy as np

from companion.mavlink.links.status import ComponentStatus, LinkStatus
from companion.mavlink.trust.dedupe import LinkShare
from companion.mavlink.voice.rate_watch import MessageRate
from companion.values import Notice, Source, UtcNs
from companion.views.words import rfc3339

Json = dict[str, Any]


def link(item: LinkStatus, share: LinkShare, now_ns: int) -> Json:
    """One link of ``/v1/status`` and ``/v1/links``."""
    return {
        "url": item.url,
        "state": item.state,
        "age_s": None if item.heard_ns is None else (now_ns - item.heard_ns) * 1e-9,
        "frames": item.frames,
        "bytes": item.bytes,
        "peers": item.peers,
        "bad_crc": item.lost.get("bad-crc", 0),
        "lost": dict(item.lost),
        "gaps": item.gaps,
        "late": item.late,
        "repeats": item.repeats,
        "arrival": item.arrival,
        "misstamped": item.misstamped,
        "overflowed": item.overflowed,
        "receive_buffer_bytes": item.receive_buffer_bytes,
        "sent": item.sent,
        "send_dropped": item.send_dropped,
        "reports": _reports(share),
    }


def out(item: LinkStatus) -> Json:
    """One link on which only is spoken."""
    return {
        "url": item.url,
        "state": item.state,
        "peers": item.peers,
        "sent": item.sent,
        "send_dropped": item.send_dropped,
    }


def _reports(share: LinkShare) -> Json:
    """A link's contribution to the reports, and how old they were."""
    total, latencies = share.first + share.repeats, list(share.latencies_s)
    p50, p95 = np.percentile(latencies, [50, 95]).tolist() if latencies else (None, None)
    return {
        "total": total,
        "first": share.first,
        "first_share": share.first / total if total else None,
        "latency_p50_s": p50,
        "latency_p95_s": p95,
    }


def components(item: LinkStatus, now_ns: int) -> list[Json]:
    """Components heard over a link, by system and component."""
    return [_component(who, heard, now_ns) for who, heard in sorted(item.components.items())]


def _component(who: Source, heard: ComponentStatus, now_ns: int) -> Json:
    return {
        "id": str(who),
        "frames": heard.frames,
        "gaps": heard.gaps,
        "age_s": (now_ns - heard.heard_ns) * 1e-9,
        "mavlink": heard.version,
    }


def rate(item: MessageRate) -> Json:
    """One message whose rate is asked for."""
    return {
        "uav": str(item.uav),
        "message_id": item.msgid,
        "wanted_hz": item.wanted_hz,
        "observed_hz": item.observed_hz,
        "state": str(item.state),
        "asked": item.asked,
        "changed_by": item.changed_by,
    }


def event(notice: Notice, at_ns: UtcNs) -> Json:
    """One entry of ``/v1/events``."""
    return {
        "at": rfc3339(at_ns),
        "severity": str(notice.severity),
        "subject": notice.subject,
        "text": notice.text,
    }
