"""Links over a network that goes down, and peers that vanish silently.

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
import asyncio, fcntl, socket, struct, sys
from link_support import LOOPS, frame, running, runner, until_true
from companion.mavlink.links import tcp, transport, udp
from companion.mavlink.wire.encode import heartbeat
from companion.values import Source

def loopback(up):
    SIOCSIFFLAGS, SIOCSIFADDR, IFF_UP = 0x8914, 0x8916, 1
    with socket.socket(type=socket.SOCK_DGRAM) as control:
        if not up:  # without its address there is no way over it; it has one again when it is up
            fcntl.ioctl(control, SIOCSIFADDR, struct.pack("16sH14x", b"lo", socket.AF_INET))
        fcntl.ioctl(control, SIOCSIFFLAGS, struct.pack("16sH14x", b"lo", IFF_UP * up))

"""


def alone(loop: str, test: str) -> None:
    """Run ``async def test()`` in its own network namespace, on that loop."""
    try:
        subprocess.run(
            ("unshare", "--net", "true"), check=True, capture_output=True, timeout=HANG_S
        )
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("the system gives no network namespace")
    script = f"{HEAD}{test}\nrunner({loop!r})(test())\n"
    path = os.pathsep.join((str(TESTS), str(TESTS.parent)))
    done = subprocess.run(
        ("unshare", "--net", sys.executable, "-W", "error", "-c", script),
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
    tcp.SILENCE_S = 2
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
