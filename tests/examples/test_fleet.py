"""The fleet security example: peers without a valid certificate are rejected."""

import asyncio
import contextlib
import shutil
import subprocess
import tomllib
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from support import HANG_S, ROOT, free_port, run_async

from companion.mavlink.links.zenoh_bus import Bus
from companion.mavlink.links.zenoh_config import BusConfig, BusTls

pytest.importorskip("zenoh")

EXAMPLE = ROOT / "examples" / "fleet"
SITE = "companion/roofs"


def made(folder: Path, *names: str) -> Path:
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not here")
    command = ["sh", str(EXAMPLE / "make_certificates.sh"), str(folder), *names]
    subprocess.run(command, check=True, timeout=HANG_S)
    return folder


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(tmp_path_factory.mktemp("tls"), "roof-1", "roof-2", "looker", "guest")


def test_example_configuration_is_consistent_with_access_rights() -> None:
    said = tomllib.loads((EXAMPLE / "roof-1.toml").read_text(encoding="utf-8"))["fleet"]
    assert f"companion/{said['site']}" == SITE
    rights = (EXAMPLE / said["access_control"]).read_text(encoding="utf-8")
    assert f'"{SITE}/{said["node"]}/**"' in rights
    assert f"{said['node']}.pem" == Path(said["certificate"]).name
    assert all(one.startswith("tls/") for one in (*said["listen"], *said["connect"]))


class Node:
    """A session configured as in the example, and its received messages."""

    def __init__(
        self,
        folder: Path,
        name: str,
        endpoint: str,
        *,
        listens: bool = False,
        acl: Path | None = EXAMPLE / "access-control.json5",
    ) -> None:
        certificate = folder / f"{name}.pem"
        self.heard: list[tuple[str, bytes]] = []
        self.seen: list[tuple[str, bool]] = []
        self.near: set[str] = set()
        self.came = asyncio.Event()
        config = BusConfig(
            listen=(endpoint,) if listens else (),
            connect=() if listens else (endpoint,),
            tls=BusTls(
                ca=folder / "ca.pem",
                certificate=certificate if certificate.exists() else None,
                private_key=certificate.with_suffix(".key") if certificate.exists() else None,
            ),
            access_control=acl,
            retry_s=0.05,
        )
        self.bus = Bus(config, asyncio.get_running_loop())

    def _hear(self, key: str, payload: bytes) -> None:
        self.heard.append((key, payload))
        self.came.set()

    def _see(self, key: str, is_alive: bool) -> None:
        self.seen.append((key, is_alive))
        self.came.set()

    def _meet(self, who: str, is_joined: bool) -> None:
        (self.near.add if is_joined else self.near.discard)(who)
        self.came.set()

    def listen(self) -> None:
        self.bus.subscribe(f"{SITE}/*/heard", self._hear)
        self.bus.watch(f"{SITE}/*/alive", self._see)
        self.bus.neighbours(self._meet)

    async def until(self, enough: Any) -> None:
        async with asyncio.timeout(HANG_S):
            while not enough():
                self.came.clear()
                await self.came.wait()


@contextlib.asynccontextmanager
async def node(*arguments: Any, **options: Any) -> AsyncIterator[Node]:
    one = Node(*arguments, **options)
    await asyncio.to_thread(one.bus.open)
    try:
        one.listen()
        yield one
    finally:
        await asyncio.to_thread(one.bus.close)


async def spoken(speaker: Node, listener: Node, name: str, payload: bytes) -> None:
    """Publish under a name once the listener has subscribed."""
    while not speaker.bus.is_wanted(f"{SITE}/{name}/heard"):
        await asyncio.sleep(0.005)
    speaker.bus.put(f"{SITE}/{name}/heard", payload)


def test_nodes_communicate_and_cannot_impersonate_another(certificates: Path) -> None:
    async def test() -> None:
        endpoint = f"tls/127.0.0.1:{free_port()}"
        async with (
            node(certificates, "roof-1", endpoint, listens=True) as one,
            node(certificates, "roof-2", endpoint, acl=None) as two,
            node(certificates, "looker", endpoint, acl=None) as looker,
            node(certificates, "guest", endpoint, acl=None) as guest,
        ):
            await one.until(lambda: len(one.near) == 3)
            for stranger in (looker, guest, two):
                stranger.bus.alive(f"{SITE}/roof-3/alive")  # impersonation
            two.bus.alive(f"{SITE}/roof-2/alive")
            await one.until(lambda: one.seen)
            await spoken(looker, one, "roof-2", b"invented")
            guest.bus.put(f"{SITE}/roof-2/heard", b"invented")
            await spoken(two, one, "roof-1", b"another's")
            two.bus.put(f"{SITE}/roof-3/heard", b"another's")
            await spoken(two, one, "roof-2", b"mine")
            await one.until(lambda: one.heard)
            await spoken(one, looker, "roof-1", b"news")
            await looker.until(lambda: looker.heard)
            assert looker.heard == [(f"{SITE}/roof-1/heard", b"news")]
            # Messages of strangers were sent before and did not arrive; the guest received nothing.
            assert one.heard == [(f"{SITE}/roof-2/heard", b"mine")]
            assert one.seen == [(f"{SITE}/roof-2/alive", True)]
            assert not guest.heard and guest.seen == [(f"{SITE}/roof-3/alive", True)]  # its own
            assert not guest.bus.is_wanted(f"{SITE}/guest/heard")

    run_async(test())


def test_peer_without_a_valid_certificate_is_rejected(certificates: Path, tmp_path: Path) -> None:
    forged = made(tmp_path / "forged", "roof-2")  # a valid name, signed by another authority
    forged.joinpath("ca.pem").write_bytes(certificates.joinpath("ca.pem").read_bytes())

    async def test() -> None:
        endpoint = f"tls/127.0.0.1:{free_port()}"
        async with (
            node(certificates, "roof-1", endpoint, listens=True) as one,
            node(certificates, "nobody", endpoint, acl=None) as bare,
            node(forged, "roof-2", endpoint, acl=None) as forger,
        ):
            async with node(certificates, "roof-2", endpoint) as two:  # time for all to connect
                await one.until(lambda: one.near)
                await spoken(two, one, "roof-2", b"mine")
                await one.until(lambda: one.heard)
            assert len(one.heard) == 1
            assert not bare.near and not forger.near

    run_async(test())
