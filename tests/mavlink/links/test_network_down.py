"""Links over a network that goes down, peers that vanish silently, and silent name servers.

A separate network namespace has a loopback that a test may switch off. Without support by the
system these tests are skipped.
"""

import os
import subprocess
import sys

import pytest
from link_support import LOOPS
from support import HANG_S, ROOT

TESTS = ROOT / "tests"
HEAD = """
import asyncio, contextlib, fcntl, socket, struct, subprocess, sys, tempfile, threading
from link_support import LOOPS, frame, running, runner, until_true
from companion.mavlink.links import connecting, transport, udp
from companion.mavlink.wire.encode import heartbeat
from companion.values import Source

def loopback(up):
    SIOCSIFFLAGS, SIOCSIFADDR, IFF_UP = 0x8914, 0x8916, 1
    with socket.socket(type=socket.SOCK_DGRAM) as control:
        if not up:  # without its address there is no way over it; it has one again when it is up
            fcntl.ioctl(control, SIOCSIFADDR, struct.pack("16sH14x", b"lo", socket.AF_INET))
        fcntl.ioctl(control, SIOCSIFFLAGS, struct.pack("16sH14x", b"lo", IFF_UP * up))

"""


def alone(loop: str, test: str, after: str = "") -> None:
    """Run ``async def test()`` in its own namespaces of networks and mounts, on that loop."""
    try:
        subprocess.run(
            ("unshare", "--net", "--mount", "true"), check=True, capture_output=True, timeout=HANG_S
        )
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("the system gives no network namespace")
    script = f"{HEAD}{test}\nrunner({loop!r})(test())\n{after}"
    path = os.pathsep.join((str(TESTS), str(TESTS.parent)))
    done = subprocess.run(
        ("unshare", "--net", "--mount", sys.executable, "-W", "error", "-c", script),
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=HANG_S,
        check=False,
    )
    assert done.returncode == 0 and done.stderr == "", done.stderr


@pytest.mark.parametrize("loop", LOOPS)
def test_link_waits_for_a_network_that_is_down(loop: str) -> None:
    alone(
        loop,
        """
async def test():
    transport.RETRY_S, transport.STEADY_S, udp.OVERFLOW_CHECK_S = (0.01,), 0.05, 0.01
    async with running("udpin:0.0.0.0:5001") as (listens, heard):
        async with running("udpout:127.0.0.1:5000") as (link, inbox):
            for outage in range(2):
                await inbox.until_said(1 + 2 * outage)
                assert link.status.state == "connecting"
                assert link.send(heartbeat(Source(1, 191))) == 0
                loopback(True)
                await inbox.until_said(2 + 2 * outage)
                with socket.socket(type=socket.SOCK_DGRAM) as peer:
                    peer.bind(("127.0.0.1", 5000))
                    assert link.send(heartbeat(Source(1, 191))) == 1
                    ours = peer.recvfrom(1000)[1]
                    peer.sendto(frame(outage), ours)
                    peer.sendto(frame(outage), ("127.0.0.1", 5001))
                    await inbox.until(1 + outage)
                    await heard.until(1 + outage)
                loopback(False)
                assert link.send(heartbeat(Source(1, 191))) == 0
                assert link.status.send_dropped == 1 + outage
                assert listens.send(heartbeat(Source(1, 191))) == 0
            await inbox.until_said(5)
            down = f"link {link.url} is down: Network is unreachable; trying again"
            back = f"link {link.url} is back"
            assert inbox.texts == [down, back, down, back, down]
            assert heard.texts == [] and listens.status.state == "up"
""",
    )


def test_vanished_peer_is_detected_by_keepalive() -> None:
    """Neither end sends: only the kernel's keepalive can detect it."""
    alone(
        "uvloop",
        """
async def test():
    connecting.SILENCE_S = 2
    loopback(True)
    async with running("tcpin:127.0.0.1:5000") as (listens, heard):
        async with running("tcp:127.0.0.1:5000") as (link, inbox):
            await until_true(lambda: link.status.state == "up" and len(listens._endpoint.peers()))
            loopback(False)
            await inbox.until_said(1)
            assert inbox.texts[0].endswith("is down: Connection timed out; trying again")
            await until_true(lambda: not listens._endpoint.peers())
""",
    )


def test_link_does_not_connect_to_itself() -> None:
    """Without a listener the kernel may choose the called port as the caller's own."""
    alone(
        "uvloop",
        """
async def test():
    loopback(True)
    with open("/proc/sys/net/ipv4/ip_local_port_range", "w") as file:
        file.write("40000 40001")
    transport.RETRY_S = (0.001,)
    async with running("tcp:127.0.0.1:40000") as (link, inbox):
        for _ in range(200):
            await asyncio.sleep(0.001)
            assert link.status.state != "up"
        assert inbox.texts == [f"link {link.url} is down: Connection refused; trying again"]
""",
    )


@pytest.mark.parametrize("loop", LOOPS)
def test_silent_name_server_delays_neither_other_links_nor_the_end(loop: str) -> None:
    """A field network without an uplink: lookups take half a minute or more."""
    alone(
        loop,
        """
GONE = [f"tcp:gone{number}.example:5760" for number in range(6)]
GONE += ["udpout:gone.example:5760", "readsb:http://gone.example/aircraft.json"]

def lookups():
    return sum(thread.name == "background" for thread in threading.enumerate())

async def test():
    loopback(True)
    transport.RETRY_S, connecting.LOOKUP_S = (0.01,), 1.0
    with tempfile.NamedTemporaryFile("w") as file:
        file.write("nameserver 127.0.0.1\\noptions timeout:30 attempts:5\\n")
        file.flush()
        subprocess.run(("mount", "--bind", file.name, "/etc/resolv.conf"), check=True)
    async with contextlib.AsyncExitStack() as stack:
        server = stack.enter_context(socket.socket(type=socket.SOCK_DGRAM))
        server.bind(("127.0.0.1", 53))  # and never answers
        gone = [await stack.enter_async_context(running(url)) for url in GONE]
        for _, inbox in gone:
            await inbox.until_said(1)
            assert inbox.texts[0].endswith(
                "is down: no name server has answered for 1 s; trying again"
            )
        await stack.enter_async_context(running("tcpin:127.0.0.1:5000"))
        link, _ = await stack.enter_async_context(running("tcp:localhost:5000"))
        await until_true(lambda: link.status.state == "up")
        assert lookups() == len(GONE), "of each name one, however often it is tried"
""",
        after="assert lookups() == len(GONE)",
    )


def test_late_answer_of_a_name_server_is_used() -> None:
    alone(
        "uvloop",
        """
async def test():
    loopback(True)
    transport.RETRY_S, connecting.LOOKUP_S = (0.01,), 0.05
    answers, look_up = threading.Event(), socket.getaddrinfo

    def late(host, port, **options):
        if not options["flags"]:
            assert answers.wait(20)
            return look_up("127.0.0.1", port, **options)
        return look_up(host, port, **options)

    connecting.socket.getaddrinfo = late
    async with running("tcpin:127.0.0.1:5000"):
        async with running("tcp:gone.example:5000") as (link, inbox):
            await inbox.until_said(1)
            assert link.status.state == "connecting"
            answers.set()
            await until_true(lambda: link.status.state == "up")
""",
    )
