r"""MAVProxy module: verdicts on links in MAVProxy's console, and as labels on its map.

Load it where MAVProxy finds it, in the environment in which ``companion`` is installed:

    PYTHONPATH=examples/mavproxy mavproxy.py --master=udpin:127.0.0.1:14551 \
        --out=udpout:127.0.0.1:14550
    module load mavproxy_companion
    companion http://127.0.0.1:8080      the address of the service, if it is another one
    companion                            prints all links

The environment variable COMPANION_TOKEN holds the bearer token, if the service requires one.
"""

import os
import threading
from typing import Any

from MAVProxy.modules.lib import mp_module

from companion.client import Client, ServiceError

URL = "http://127.0.0.1:8080"
EVERY_S = 1.0
COLOURS = {"good": (0, 160, 60), "weak": (220, 150, 0), "none": (210, 40, 40)}


class CompanionModule(mp_module.MPModule):  # type: ignore[misc]
    """Module that asks the service once a second, on a thread of its own."""

    def __init__(self, mpstate: Any) -> None:
        super().__init__(mpstate, "companion", "verdicts on links")
        self.add_command("companion", self.command, "verdicts on links", ["<URL>"])
        self._url = URL
        self._uavs: list[dict[str, Any]] = []
        self._failure: str | None = None
        self._told: dict[str, str] = {}
        self._told_failure: str | None = None
        self._drawn = 0
        self._read = 0  # answers so far
        self._ends = threading.Event()
        threading.Thread(target=self._ask, name="companion", daemon=True).start()

    def unload(self) -> None:
        """End the thread."""
        self._ends.set()

    def command(self, arguments: list[str]) -> None:
        """Print all links, or change the address of the service."""
        if arguments:
            self._url = arguments[0]
            return
        for uav in self._uavs:
            print(_line(uav))

    def idle_task(self) -> None:
        """Print changed verdicts, and draw labels if a map is loaded."""
        uavs, failure = self._uavs, self._failure
        if failure != self._told_failure:
            self._told_failure = failure
            print(f"companion: {failure or 'connected'}")
        for uav in uavs:
            verdict = uav["verdict"]
            if verdict is not None and self._told.get(uav["id"]) != verdict:
                self._told[uav["id"]] = verdict
                self.console.writeln(_line(uav))
        if self._drawn != self._read:
            self._drawn = self._read
            self._draw(uavs)

    def _ask(self) -> None:
        token = os.environ.get("COMPANION_TOKEN")
        while not self._ends.wait(EVERY_S):
            try:
                self._uavs = [uav for uav in Client(self._url, token).uavs() if uav["target"]]
                self._failure = None
            except ServiceError as error:
                self._failure = str(error)
            self._read += 1

    def _draw(self, uavs: list[dict[str, Any]]) -> None:
        map_module = self.module("map")
        if map_module is None:
            return
        from MAVProxy.modules.mavproxy_map import mp_slipmap  # needs OpenCV, as the map does

        for uav in uavs:
            if uav["verdict"] is None:
                continue
            label = mp_slipmap.SlipLabel(
                f"companion {uav['id']}",
                (uav["lat_deg"], uav["lon_deg"]),
                f"{uav['id']} {uav['verdict']}",
                layer="companion",
                colour=COLOURS[uav["verdict"]],
            )
            map_module.map.add_object(label)


def _line(uav: dict[str, Any]) -> str:
    health = uav["health"] or {}
    why = f": {health['reason']}; {health['remedy']}" if health.get("reason") else ""
    return f"companion: {uav['id']} {uav['verdict'] or 'not assessed'}{why}"


def init(mpstate: Any) -> CompanionModule:
    """Return the module; MAVProxy calls this."""
    return CompanionModule(mpstate)
