"""The demo: the paper's scenario over loopback UDP into the service."""

import asyncio
from typing import Final

from companion.settings.model import Settings
from sitl_replay.flight import scenario
from sitl_replay.traffic import player

LINK: Final = "udpin:127.0.0.1:0"  # link of the demo; the system chooses the port


def settings(directory: str) -> Settings:
    """Return the service's settings for the paper's scenario.

    Speeds are up to 125 m/s plus gusts of a fifth. The acceleration is that of circling and of the
    gusts: R w^2 + 0.2 R w 10 w at R = 250 m and w = 0.5 rad/s (docs/math.md 8.2).
    """
    return Settings().override(
        center={"source": "5:1"},
        links={"urls": [LINK]},
        observer={
            "lag_s": (0.0, 0.0),  # the simulated stamps are exact
            "speed_max_mps": 151.0,
            "acceleration_max_mps2": 190.0,
            "position_noise_m": 1.0,
            "velocity_noise_mps": 0.1,
        },
        recording={"directory": directory},
    )


async def traffic(link_url: str) -> None:
    """Fly the scenario and send it to the service's link, until cancelled."""
    target = link_url.replace("udpin:", "udpout:", 1)
    await player.fly(scenario.paper(), [target])
    await asyncio.get_running_loop().create_future()
