"""A recording is untrusted: it names no address at which its replay would listen."""

from companion.settings.model import Settings


def test_address_of_observations_in_a_recording_is_ignored() -> None:
    given = Settings().override(
        observations={"enabled": True, "udp": "127.0.0.1:9000", "outliers": 2}
    )
    found = Settings.from_recording(given.to_toml(), "recording.mcap", {})
    assert found.observations.udp is None
    assert found.observations.outliers == 2
