"""Servers share the process's file descriptors, whatever its limit is."""

import os
import resource
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from siege import RUN
from support import BIN

from companion.mavlink.links import descriptors, tcp
from companion.server import connections, stream

LIMITED = """
import resource, sys
resource.setrlimit(resource.RLIMIT_NOFILE, (220, 220))
from companion.__main__ import main
main()
"""


@pytest.mark.parametrize(
    ("soft", "http", "links"), [(4096, 512, 256), (1024, 464, 92), (256, 80, 16), (90, 8, 8)]
)
def test_connections_leave_descriptors_for_links_and_recordings(
    monkeypatch: pytest.MonkeyPatch, soft: int, http: int, links: int
) -> None:
    monkeypatch.setattr(descriptors.resource, "getrlimit", lambda _: (soft, soft))
    assert connections.most_connections() == http
    assert stream.most_clients() == http // 2
    assert descriptors.share(tcp.CONNECTIONS_MAX, tcp.DESCRIPTORS) == links


def test_without_a_limit_there_are_as_many_connections_as_usual(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    none = resource.RLIM_INFINITY
    monkeypatch.setattr(descriptors.resource, "getrlimit", lambda _: (none, none))
    assert connections.most_connections() == connections.CONNECTIONS_MAX


def test_service_does_not_start_with_too_few_descriptors() -> None:
    command = f"ulimit -n 24; '{BIN / 'companion'}' run --link udpin:127.0.0.1:0 --center 5:1"
    found = subprocess.run(
        ["sh", "-c", f"{command} --listen 127.0.0.1:0"],
        check=False,
        capture_output=True,
        text=True,
        timeout=60,
    )
    said = "companion: file descriptor limit is 24, the service needs 64; raise it with `ulimit -n`"
    assert (found.returncode, found.stderr.splitlines()[-1]) == (1, said)
    assert "Traceback" not in found.stderr


def test_descriptors_are_scarce_when_nearly_all_are_in_use(monkeypatch: pytest.MonkeyPatch) -> None:
    soft = 1 + max(int(one.name) for one in Path("/proc/self/fd").iterdir())
    monkeypatch.setattr(descriptors.resource, "getrlimit", lambda _: (10 * soft, 10 * soft))
    assert not descriptors.are_scarce()
    held = [os.open(os.devnull, os.O_RDONLY) for _ in range(9 * soft)]
    try:
        assert descriptors.are_scarce()
    finally:
        for one in held:
            os.close(one)
    assert not descriptors.are_scarce()


@pytest.mark.skipif(sys.platform != "linux", reason="reads the limit in /proc")
def test_service_raises_its_limit_as_far_as_it_may(start_node: Any) -> None:
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    node = start_node(*RUN, code=LIMITED.replace("(220, 220)", f"(220, {hard})"))
    (line,) = (
        line
        for line in Path(f"/proc/{node.process.pid}/limits").read_text().splitlines()
        if line.startswith("Max open files")
    )
    assert int(line.split()[3]) == min(descriptors.WANTED, hard)


def test_page_is_reachable_while_connections_fill_all_links(start_node: Any) -> None:
    words = [word for _ in range(3) for word in ("--link", "tcpin:127.0.0.1:0")]
    node = start_node(*RUN, *words, code=LIMITED)
    urls = [one["url"] for one in node.json("/v1/links")["links"]]
    ports = [int(url.rpartition(":")[2]) for url in urls if url.startswith("tcpin:")]
    assert len(ports) == 3
    held = [socket.create_connection(("127.0.0.1", port), 5) for port in ports for _ in range(100)]
    assert node.get("/healthz")[0] == 200
    for one in held:
        one.close()
