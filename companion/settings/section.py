"""The base class of all sections of the settings, and the error of unusable settings."""

from pydantic import BaseModel, ConfigDict

from companion.values import UserError


class ConfigError(UserError):
    """Settings that cannot be used."""


class Section(BaseModel):
    """A section of the settings: frozen, and any unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
