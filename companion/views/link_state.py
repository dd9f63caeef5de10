"""Links and requested message rates, as shown by the API."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from companion.mavlink.links.status import ComponentStatus, LinkStatus
from companion.mavlink.trust.dedupe import LinkShare
from companion.mavlink.voice.rate_watch import MessageRate
from companion.values import Source
from companion.values.described import Inline, Meaning


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkReports:
    """Reports received over a link: how many, and how old they were at arrival."""

    total: Annotated[int, Meaning("reports received over this link")]
    first: Annotated[int, Meaning("reports that no other link delivered before")]
    first_share: Annotated[
        float | None,
        Meaning("share of reports that no other link delivered before, 0 to 1", label="First"),
    ]
    latency_p50_s: Annotated[float | None, Meaning("median age at arrival")]
    latency_p95_s: Annotated[
        float | None, Meaning("95th percentile of the age at arrival", label="Latency")
    ]


@dataclass(frozen=True, slots=True)
class LinkState:
    """Link; ``lost`` counts rejected frames by reason, and garbage in bytes."""

    status: Annotated[LinkStatus, Inline()]
    age_s: Annotated[float | None, Meaning("time since the last frame")]
    reports: Annotated[LinkReports, Meaning("reports over this link, and their age")]


@dataclass(frozen=True, slots=True)
class Component:
    """Component received over a link."""

    id: Annotated[Source, Meaning("SYSID:COMPID", example="3:1")]
    status: Annotated[ComponentStatus, Inline()]
    age_s: Annotated[float, Meaning("time since the component's last frame")]


@dataclass(frozen=True, slots=True)
class HeardLink:
    """Link with the components received over it."""

    link: Annotated[LinkState, Inline()]
    components: Annotated[list[Component], Meaning("components received, by id")]


@dataclass(frozen=True, slots=True)
class OutLink:
    """Link of ``[out]``, which only sends."""

    status: Annotated[
        LinkStatus,
        Inline(
            omit=("frames", "bytes", "bad_crc", "lost", "gaps", "late", "repeats", "arrival",
                  "misstamped", "overflowed", "receive_buffer_bytes")
        ),
    ]  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Links:
    """Links with the components received over each, and the requested message rates."""

    valid_at_ns: Annotated[int, Meaning("the instant for which the values hold")]
    links: Annotated[list[HeardLink], Meaning("the links, in the order of the settings")]
    out: Annotated[list[OutLink], Meaning("links of `[out]`, which only send")]
    message_rates: Annotated[list[MessageRate], Meaning("rates requested of UAVs")]


Components = list[tuple[Source, ComponentStatus]]
"""Components received over a link, with their counts."""


def link(item: LinkStatus, share: LinkShare, now_ns: int) -> LinkState:
    """Return a link in the form of ``/v1/status`` and ``/v1/links``."""
    age_s = None if item.heard_ns is None else (now_ns - item.heard_ns) * 1e-9
    total, latencies = share.first + share.repeats, list(share.latencies_s)
    p50, p95 = np.percentile(latencies, [50, 95]).tolist() if latencies else (None, None)
    first_share = share.first / total if total else None
    return LinkState(
        item,
        age_s,
        LinkReports(
            total=total,
            first=share.first,
            first_share=first_share,
            latency_p50_s=p50,
            latency_p95_s=p95,
        ),
    )


def components(received: Components, now_ns: int) -> list[Component]:
    """Return the components received over a link, ordered by system and component.

    Those may receive frames meanwhile, after ``now_ns``; their age is then 0.
    """
    return [
        Component(who, heard, max(0, now_ns - heard.heard_ns) * 1e-9)
        for who, heard in sorted(received, key=lambda pair: pair[0])
    ]
