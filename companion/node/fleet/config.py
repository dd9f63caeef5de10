"""What the settings of a fleet say of its Zenoh session."""

from pathlib import Path

from companion.mavlink.links.zenoh_config import BusConfig, BusTls
from companion.settings.fleet import FleetSettings
from companion.settings.section import ConfigError


def bus_config(settings: FleetSettings) -> BusConfig:
    """What the settings say of the Zenoh session. Raises ``ConfigError``."""
    tls = None
    if settings.ca is not None:
        if settings.certificate is None or settings.key is None:
            raise ConfigError("fleet.ca: a certificate and its key are needed as well")
        tls = BusTls(
            ca=Path(settings.ca),
            certificate=Path(settings.certificate),
            private_key=Path(settings.key),
        )
    elif settings.certificate is not None or settings.key is not None:
        raise ConfigError("fleet.certificate: fleet.ca is needed as well")
    if settings.mode == "client" and not settings.connect:
        raise ConfigError("fleet.connect: a client needs a router to connect to")
    return BusConfig(
        mode=settings.mode,
        listen=settings.listen if settings.mode == "peer" else (),
        connect=settings.connect,
        tls=tls,
        access_control=None if settings.access_control is None else Path(settings.access_control),
        lease_s=settings.lease_s,
        attempt_s=settings.attempt_s,
    )
