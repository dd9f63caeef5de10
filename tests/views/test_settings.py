"""The effective settings as the API shows them."""

from companion.settings.model import Settings
from companion.views import settings


def test_every_setting_is_shown_with_where_it_comes_from() -> None:
    given = Settings().override(link={"needed_db": 6.0}, center={"source": "5:1"})
    sections = settings.show(given)["sections"]
    assert set(sections) == set(Settings.model_fields)
    assert sections["link"]["needed_db"] == {"value": 6.0, "default": 0.0, "source": "set"}
    assert sections["link"]["needed_sinr_db"] == {
        "value": None, "default": None, "source": "default",
    }  # fmt: skip
    told = {
        f"{section}.{key}"
        for section, keys in sections.items()
        for key, shown in keys.items()
        if shown["source"] == "set"
    }
    assert told == {"link.needed_db", "center.source"}
