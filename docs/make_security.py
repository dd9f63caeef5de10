"""Write the table of ways in, and their budgets, into docs/security.md.

    python docs/make_security.py [--check]

The numbers are those of the code. With --check nothing is written; status 1 says that the page is
not up to date. ``tests/test_ways_in.py`` fails for a link scheme, a route or a kind of file that no
row covers.
"""

# ruff: noqa: E501 - cells of a table

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from companion.beams.hardware import codebooks, phaser_pickles
from companion.mavlink.links import http_poll, kinds, tcp, to_loop, transport, udp, zenoh_config
from companion.mavlink.trust import known_peers, newcomers
from companion.mavlink.wire import aircraft_json, cot_link, foreign, rid_json, sbs
from companion.node import observations
from companion.node.drive import gimbal, rotctld
from companion.node.fleet import budgets, messages
from companion.pipeline import power_beams
from companion.recording import background
from companion.recording.foreign import capture, thinned
from companion.server import (
    access,
    byte_ranges,
    connections,
    giving_way,
    held_bodies,
    observation_routes,
    playback,
    request_queue,
    stream,
    websocket_connections,
    work_slots,
)
from companion.settings import files
from companion.views import observation_records

PAGE: Final = Path(__file__).resolve().parent / "security.md"
BEGIN, END = "<!-- ways in: written by docs/make_security.py -->", "<!-- end of ways in -->"


@dataclass(frozen=True, kw_only=True)
class WayIn:
    """A way by which strangers reach the service, and its budget.

    ``covers`` names link schemes (``link:``), routes (``route:``), kinds of files (``file:``) or
    devices (``device:``). ``over`` is what happens beyond the budget; ``test`` exhausts it.
    """

    name: str
    covers: tuple[str, ...]
    size: str
    items: str
    work: str
    over: str
    test: str


def kb(size: int) -> str:
    """Return a size in the largest whole unit."""
    if size >= 1 << 20:
        return f"{size >> 20} MB"
    return f"{size >> 10} kB" if size >= 1024 else f"{size} bytes"


NEW: Final = f"{newcomers.NEW_PER_S:.0f} new senders/s, {newcomers.NEW_SAVED:.0f} at once"
STRANGERS: Final = (
    f"{known_peers.COMPARED_PER_S:.0f} positions/s of strangers are compared for each sender"
)
OLDEST: Final = (
    f"fair shares, then the oldest senders first, above {100 * newcomers.BUSY:.0f} % of the time,"
    f" or while frames are late by {newcomers.USELESS_NS / 1e9:g} s"
)
RECEIVER: Final = (
    f"{100 * transport.RECEIVER_SHARE:.0f} % of the time for a link,"
    f" {100 * transport.RECEIVERS_SHARE:.0f} % for all, {transport.RECEIVER_SAVED_S:g} s at once"
)
LOOP: Final = (
    f"{request_queue.AT_ONCE} started in an iteration; less than 2 ms each on the event loop"
)
SLOTS: Final = (
    f"{work_slots.AT_ONCE} at a time on threads, in turns of {1e3 * giving_way.TURN_S:.0f} ms,"
    f" {work_slots.WAITING} waiting; after more than"
    f" {1e3 * work_slots.RESTS_FROM_S:.0f} ms a rest of {work_slots.REST:g} times as long, at most {work_slots.REST_MAX_S:g} s, or {work_slots.OVERLOADED_REST_MAX_S:g} s while the machine is overloaded"
)
BUDGET: Final = (
    f"{observations.OBSERVATIONS_PER_S:.0f} observations/s,"
    f" {observations.OBSERVATIONS_SAVED:.0f} at once"
)
SIEGE: Final = "tests/live/test_siege.py::test_attack_costs_no_beam_and_no_bound"
LISTEN: Final = "tests/mavlink/links/test_listen_only.py"
HOSTILE: Final = "tests/server/test_connection_budgets.py"
LOGS: Final = "tests/recording/test_hostile.py"

WAYS: Final = (
    WayIn(
        name="MAVLink over UDP",
        covers=("link:udpin", "link:udpout"),
        size=f"{kb(udp.RECEIVE_BUFFER_BYTES)} in the kernel, at most {udp.STALE_NS / 1e9:.0f} s old;"
        f" {kb(udp.WAITING_MAX_BYTES)} of a peer behind a large datagram",
        items=f"{NEW}; {STRANGERS}",
        work=OLDEST,
        over="dropped before decoding, counted (`newcomer`, `stranger`, `socket-overflow`)",
        test=SIEGE,
    ),
    WayIn(
        name="MAVLink over TCP, serial lines",
        covers=("link:tcp", "link:tcpin", "link:serial"),
        size=f"pieces of {kb(tcp.PIECE_BYTES)}",
        items=f"{tcp.CONNECTIONS_MAX} connections; {NEW}",
        work=OLDEST,
        over="the sender waits; the oldest connection without a frame makes room for another",
        test="tests/mavlink/links/test_transport.py::test_flood_over_a_connection_is_processed_in_pieces",
    ),
    WayIn(
        name="Zenoh: MAVLink and fleets",
        covers=("link:zenoh",),
        size=f"{kb(zenoh_config.MESSAGE_MAX)} a sample, {kb(to_loop.BYTES_MAX)} waiting",
        items=f"{to_loop.QUEUE_MAX} samples waiting; {messages.FRAMES_MAX} frames and {messages.OFFERS_MAX} offers in a message",
        work=f"slices of {1e3 * to_loop.SLICE_S:.0f} ms, {kinds.FRAMES_AT_ONCE} frames at once; {budgets.NODE_BYTES_PER_S // 1000} kB/s of a node of a fleet, {budgets.ALL_BYTES_PER_S // 1000} kB/s of all beyond {budgets.GUARANTEED_BYTES_PER_S // 1000} kB/s each",
        over="dropped and counted",
        test="tests/mavlink/links/test_zenoh_bus.py::test_receive_queue_is_bounded",
    ),
    WayIn(
        name="receivers: SBS, Beast, Remote ID, Cursor on Target",
        covers=("link:sbs", "link:readsb", "link:rid", "link:cot"),
        size=f"{kb(sbs.LINE_MAX)} a line, {kb(rid_json.OBJECT_MAX)} an object, {kb(cot_link.EVENT_MAX)} an event",
        items=f"{aircraft_json.AIRCRAFT_MAX} aircraft",
        work=f"{RECEIVER}, behind vehicles; {kb(foreign.PIECE * foreign.PIECES)} or"
        f" {foreign.AT_ONCE} messages before other work runs",
        over=f"skipped before parsing, counted (`too-frequent`); a server without a complete message in {transport.UNFINISHED_S} s is disconnected",
        test=f"{LISTEN}::test_receiver_beyond_its_share_of_the_time_is_skipped_and_counted",
    ),
    WayIn(
        name="aircraft.json over HTTP",
        covers=("link:readsb:http",),
        size=f"{kb(http_poll.HEAD_MAX)} of headers, {kb(http_poll.BODY_MAX)} of body",
        items=f"{aircraft_json.AIRCRAFT_MAX} aircraft",
        work=f"one request at a time; {RECEIVER}",
        over="the poll fails, with a notice; aircraft are skipped, counted (`too-frequent`)",
        test="tests/mavlink/wire/test_aircraft_json.py::test_too_many_aircraft_use_bounded_memory",
    ),
    WayIn(
        name="HTTP connections",
        covers=("connections",),
        size=f"{kb(connections.HEAD_BYTES)} of head, {kb(connections.BODY_BYTES)} of body, {kb(connections.PIECE_BYTES)} parsed ahead, {kb(connections.BUFFER_BYTES)} of answer",
        items=f"{connections.CONNECTIONS_MAX} connections; {connections.REQUESTS_PER_S:.0f} requests/s each, {request_queue.REQUESTS_PER_S:.0f}/s in all",
        work=LOOP,
        over="requests wait, after those of others; clients that take nothing for "
        f"{connections.STALL_TIMEOUT_S:.0f} s are disconnected",
        test=f"{HOSTILE}::test_pipelined_requests_wait_in_the_client",
    ),
    WayIn(
        name="answers from the event loop",
        covers=(
            "route:/healthz", "route:/register_service", "route:/readyz", "route:/v1/status", "route:/v1/events",
            "route:/v1/fleet", "route:/v1/labels", "route:/v1/map", "route:/v1/settings",
            "route:/v1/links", "route:/v1/uavs/{uav}",
        ),
        size="-",
        items="as of the connection",
        work=LOOP,
        over="as of the connection",
        test="tests/server/test_route_cost.py::test_no_route_holds_the_event_loop",
    ),
    WayIn(
        name="answers that are computed",
        covers=(
            "route:/v1/uavs", "route:/metrics", "route:/v1/design", "route:/v1/history",
            "route:/v1/beams", "route:/v1/beams/weights", "route:/v1/pattern",
            "route:/v1/mavlink/vehicles",
            "route:/v1/mavlink/vehicles/{sys}/components/{comp}/messages",
            "route:/v1/mavlink/vehicles/{sys}/components/{comp}/messages/{name}",
        ),
        size=f"{held_bodies.BYTES_MAX >> 20} MB of bodies and messages of streams that clients have not taken yet",
        items="one for all that ask for the same moment",
        work=SLOTS,
        over="503, before any work; the oldest answers are abandoned, or streams closed",
        test="tests/server/test_hostile_clients.py::test_excess_work_is_rejected_with_503",
    ),
    WayIn(
        name="observations over HTTP",
        covers=("route:/v1/observations",),
        size=f"{kb(connections.BODY_BYTES)} of body",
        items=f"{observation_routes.OBSERVATIONS_MAX} observations in a request; {BUDGET}",
        work=f"slices of {1e3 * observation_routes.SLICE_S:.0f} ms on the event loop",
        over="413; dropped before validation, counted (`too-frequent`), 503",
        test="tests/server/test_observations.py::test_observations_beyond_the_budget_are_dropped",
    ),
    WayIn(
        name="observations over UDP",
        covers=("observations",),
        size=f"{kb(udp.RECEIVE_BUFFER_BYTES)} in the kernel, at most {udp.STALE_NS / 1e9:.0f} s old; {observation_records.LARGEST_RECORD} bytes a record",
        items=f"{BUDGET}, over UDP and HTTP together",
        work=f"{udp.READ_AT_ONCE} datagrams, or {1e3 * to_loop.SLICE_S:.0f} ms, in an iteration",
        over="dropped before decoding, counted (`too-frequent`, `socket-overflow`)",
        test="tests/node/test_observations.py::test_flood_is_limited_by_the_budget_and_counted",
    ),
    WayIn(
        name="powers in observations",
        covers=(),
        size=f"weights of the newest {power_beams.UPDATES_KEPT} updates, at most {16 * power_beams.ENTRIES_KEPT >> 20} MB",
        items=f"{power_beams.POWERS_PER_S:.0f} observations/s, {power_beams.POWERS_SAVED:.0f} at once",
        work="one search with a work limit, some milliseconds",
        over="rejected and counted (`too-frequent`)",
        test="tests/pipeline/test_power_observations.py::test_powers_beyond_the_budget_are_rejected",
    ),
    WayIn(
        name="files over HTTP",
        covers=("route:/v1/recordings", "route:/v1/recordings/{name}", "route:/v1/map/tiles", "page"),
        size=f"{kb(byte_ranges.PIECE_BYTES)} of a file in memory; the page's files are read once",
        items="as of the connection",
        work=LOOP,
        over="as of the connection",
        test=f"{HOSTILE}::test_client_that_takes_nothing_of_an_answer_is_disconnected",
    ),
    WayIn(
        name="recordings played on the page",
        covers=("route:/v1/recordings/{name}/history",),
        size=f"{kb(playback.LINE_MAX_BYTES)} of samples",
        items="1 recording at a time",
        work=f"a process of its own at the lowest priority, at most {playback.READ_MAX_S:.0f} s",
        over=f"409; ended after {playback.IDLE_S:.0f} s without a request",
        test="tests/server/test_playback.py::test_one_recording_is_read_at_a_time",
    ),
    WayIn(
        name="WebSocket `/v1/stream`",
        covers=("route:/v1/stream",),
        size=f"{websocket_connections.BYTES_PER_S:.0f} bytes/s from a client, {kb(int(websocket_connections.BYTES_SAVED))} at once; nothing is queued for it; its unread messages count as bodies of answers",
        items=f"{stream.CLIENTS_MAX} clients, at most half of the connections; {request_queue.STREAMS_PER_S:.0f} new ones/s;"
        f" {stream.MESSAGES_PER_S:.0f} messages/s to all",
        work="a message is encoded once for all",
        over="closed and not read",
        test=f"{HOSTILE}::test_flood_of_pings_closes_the_websocket",
    ),
    WayIn(
        name="bearer tokens",
        covers=("tokens",),
        size=f"at least {access.TOKEN_MIN} characters",
        items=f"{access.WRONG_MAX} wrong ones of an address, then {access.WRONG_PER_S:g}/s;"
        f" {access.WRONG_ALL_MAX} of all, then {access.WRONG_ALL_PER_S:g}/s",
        work="-",
        over=f"answered {access.WRONG_DELAY_S:.0f} s later, counted, with a notice",
        test=f"{HOSTILE}::test_wrong_tokens_are_counted_told_and_answered_late",
    ),
    WayIn(
        name="recordings and logs",
        covers=("file:mcap", "file:tlog", "file:dataflash", "file:ulog", "file:capture", "file:csv"),
        size="lengths are checked against the file before unpacking; below 300 MB, besides the pages"
        " of a large file",
        items=f"{thinned.SAMPLES_MAX} samples of a kind; {kb(capture.WAITING_BYTES)} of TCP segments"
        " that wait",
        work="linear in the file, with progress",
        over="damage is skipped and counted",
        test=f"{LOGS}::test_decompression_bombs_are_read_in_bounded_memory",
    ),
    WayIn(
        name="settings and calibrations",
        covers=("file:toml", "file:json", "file:calibration", "file:npz", "file:pickle"),
        size=f"{kb(files.TEXT_BYTES)} of settings, {kb(files.NAMED_TEXT_BYTES)} of another text, {kb(files.LARGEST_BYTES)} of an array; {kb(phaser_pickles.LARGEST_BYTES)} of a pickle",
        items=f"{codebooks.ENTRIES_MAX} weights of a codebook",
        work="linear in the text",
        over="rejected in one line",
        test="tests/settings/test_load.py::test_expensive_toml_is_rejected_in_one_line",
    ),
    WayIn(
        name="replies of devices",
        covers=("device:rotctld", "device:gimbal", "device:phaser", "device:adar1000"),
        size=f"{kb(rotctld.ANSWER_MAX_BYTES)} an answer",
        items=f"{gimbal.RECEIVED_MAX} datagrams of a gimbal in an update",
        work="on a thread of its own",
        over="the device failed: counted, announced, tried again",
        test="tests/node/drive/test_mount.py::test_malformed_answers_are_device_errors",
    ),
    WayIn(
        name="the recorder",
        covers=("recorder",),
        size=f"{kb(background.MIN_FREE_BYTES)} of the disk stay free",
        items=f"{background.QUEUE_MAX} events waiting",
        work="on a thread of its own",
        over="events are not recorded, which is counted and announced",
        test="tests/live/test_all_together.py::test_service_survives_all_faults_at_once_and_records_all",
    ),
)  # fmt: skip


def table() -> str:
    """Return the table in Markdown."""
    head = "| way in | bytes | items | work | beyond it | test |\n|---|---|---|---|---|---|\n"
    return head + "".join(
        f"| {one.name} | {one.size} | {one.items} | {one.work} | {one.over} | `{one.test}` |\n"
        for one in WAYS
    )


def page(text: str) -> str:
    """Return the page with a new table."""
    before, rest = text.split(BEGIN)
    return f"{before}{BEGIN}\n{table()}{END}{rest.split(END)[1]}"


def main() -> int:
    """Write the page, or check it."""
    text = PAGE.read_text(encoding="utf-8")
    if "--check" in sys.argv[1:]:
        return int(page(text) != text)
    PAGE.write_text(page(text), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
