"""Paths in settings name something."""

import pytest

from companion.settings.model import Settings
from companion.settings.section import ConfigError


@pytest.mark.parametrize(
    ("section", "key", "text"),
    [
        ("recording", "directory", ""),
        ("records", "shared_memory", ""),
        ("records", "shared_memory", "."),
        ("records", "shared_memory", "/"),
        ("signing", "timestamps", ""),
        ("signing", "timestamps", "."),
    ],
)
def test_path_that_names_nothing_is_an_error(section: str, key: str, text: str) -> None:
    """As an unset variable of a shell gives it."""
    with pytest.raises(ConfigError, match=rf"{section}\.{key} .*not the name of a (file|folder)"):
        Settings().override(**{section: {key: text}})


def test_current_folder_may_hold_recordings() -> None:
    assert Settings().override(recording={"directory": "."}).recording.directory == "."
