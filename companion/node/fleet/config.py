"""Configuration of the Zenoh session from the settings of a fleet."""

from pathlib import Path

from companion.mavlink.links.zenoh_config import BusConfig, BusTls
from companion.settings.fleet import FleetSettings
from companion.settings.section import ConfigError


def bus_config(settings: FleetSettings) -> BusConfig:
    """Return the configuration of the Zenoh session. Raises ``ConfigError``."""
    tls = None
    if settings.ca is not None:
        if settings.certificate is None or settings.key is None:
            raise ConfigError("fleet.ca: set fleet.certificate and fleet.key as well")
        tls = BusTls(
            ca=Path(settings.ca),
            certificate=Path(settings.certificate),
            private_key=Path(settings.key),
        )
    elif settings.certificate is not None or settings.key is not None:
        raise ConfigError("fleet.certificate: set fleet.ca as well")
    if settings.mode == "client" and not settings.connect:
        raise ConfigError("fleet.connect is empty; a client needs the address of a router")
    return BusConfig(
        mode=settings.mode,
        listen=settings.listen if settings.mode == "peer" else (),
        connect=settings.connect,
        tls=tls,
        access_control=None if settings.access_control is None else Path(settings.access_control),
        lease_s=settings.lease_s,
        attempt_s=settings.attempt_s,
    )
