"""Base class of all sections of the settings, and the error for unusable settings."""

from pydantic import BaseModel, ConfigDict

from companion.values import UserError


class ConfigError(UserError):
    """Error of unusable settings."""


class Section(BaseModel):
    """Base of a settings section: frozen; unknown keys are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
