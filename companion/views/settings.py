"""The effective settings as the API shows them: each with its default, and whether it is that."""

from typing import Any

from companion.settings.model import Settings

Json = dict[str, Any]


def show(settings: Settings) -> Json:
    """The answer of ``/v1/settings``.

    ``source`` is "default", or "set" where the file or a flag says otherwise than the default.
    """
    plain, effective = Settings().model_dump(mode="json"), settings.model_dump(mode="json")
    return {
        "sections": {
            section: {
                key: {
                    "value": value,
                    "default": plain[section][key],
                    "source": "default" if value == plain[section][key] else "set",
                }
                for key, value in keys.items()
            }
            for section, keys in effective.items()
        }
    }
