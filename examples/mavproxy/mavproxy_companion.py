r"""MAVProxy module: verdicts on links in MAVProxy's console, and as labels on its map.

Load it where MAVProxy finds it, in the environment in which ``companion`` is installed:

    PYTHONPATH=examples/mavproxy mavproxy.py --master=udpin:127.0.0.1:14551 \
        --out=udpout:127.0.0.1:14550
    module load map                      for the labels; needs wxPython, OpenCV and Matplotlib
    module load mavproxy_companion
    companion http://127.0.0.1:8080      the address of the service, if it is another one
    companion                            prints all links

A label shows the UAV, its verdict and its guaranteed gain. It is removed when the UAV is no longer
a target, and when the service does not answer. The environment variable COMPANION_TOKEN holds the
bearer token, if the service requires one.
"""

import os
import threading
from typing import Any

from MAVProxy.modules.lib import mp_module

from companion.client import Client, ServiceError

Uav = dict[str, Any]

URL = "http://127.0.0.1:8080"
EVERY_S = 1.0
LAYER = "companion"
COLOURS = {"good": (80, 255, 120), "weak": (255, 190, 0), "none": (255, 90, 90)}  # RGB


class CompanionModule(mp_module.MPModule):  # type: ignore[misc]
    """Module that asks the service once a second, on a thread of its own."""

    def __init__(self, mpstate: Any) -> None:
        super().__init__(mpstate, "companion", "verdicts on links")
        self.add_command("companion", self.command, "verdicts on links", ["<URL>"])
        self._url = URL
        self._answer: tuple[list[Uav], str | None] = ([], None)  # UAVs, and why there are none
        self._read = 0  # answers so far
        self._drawn = 0
        self._told: dict[str, str] = {}
        self._told_failure: str | None = None
        self._labelled: set[str] = set()
        self._ends = threading.Event()
        threading.Thread(target=self._ask, name="companion", daemon=True).start()

    def unload(self) -> None:
        """End the thread, and remove the labels."""
        self._ends.set()
        self._draw([])
        super().unload()

    def command(self, arguments: list[str]) -> None:
        """Print all links, or change the address of the service."""
        if arguments:
            self._url = arguments[0]
            return
        uavs, failure = self._answer
        for line in [f"companion: {failure}"] if failure else map(_line, uavs):
            print(line)

    def idle_task(self) -> None:
        """Print changed verdicts, and renew the labels after each answer."""
        uavs, failure = self._answer
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
                answer = Client(self._url, token).uavs()
                self._answer = ([uav for uav in answer if uav["target"]], None)
            except ServiceError as error:
                self._answer = ([], str(error))
            self._read += 1

    def _draw(self, uavs: list[Uav]) -> None:
        """Draw a label for each UAV with a verdict on every map, and remove all others."""
        labelled = {f"{LAYER} {uav['id']}": uav for uav in uavs if uav["verdict"] is not None}
        for module in self.module_matching("map*"):
            from MAVProxy.modules.mavproxy_map import mp_slipmap  # needs OpenCV, as the map does

            for key in self._labelled - labelled.keys():
                module.map.remove_object(key)
            for key, uav in labelled.items():
                point, colour = (uav["lat_deg"], uav["lon_deg"]), COLOURS[uav["verdict"]]
                module.map.add_object(
                    mp_slipmap.SlipLabel(key, point, _label(uav), layer=LAYER, colour=colour)
                )
        self._labelled = set(labelled)


def _label(uav: Uav) -> str:
    gain_db = (uav["health"] or {}).get("guaranteed_gain_db")
    return f"{uav['id']} {uav['verdict']}" + ("" if gain_db is None else f" {gain_db:.1f} dB")


def _line(uav: Uav) -> str:
    health = uav["health"] or {}
    why = f": {health['reason']}; {health['remedy']}" if health.get("reason") else ""
    return f"companion: {uav['id']} {uav['verdict'] or 'not assessed'}{why}"


def init(mpstate: Any) -> CompanionModule:
    """Return the module; MAVProxy calls this."""
    return CompanionModule(mpstate)
