"""Base class of all sections of the settings, and the error for unusable settings."""

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict

from companion.values import UAV_FORMS, UserError, is_uav_id, shown


class ConfigError(UserError):
    """Error of unusable settings."""


class Section(BaseModel):
    """Base of a settings section: frozen; unknown keys are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def _uav_id(text: str) -> str:
    if not is_uav_id(text):
        raise UserError(f"not the id of a UAV; give {UAV_FORMS}")
    return text


UavName = Annotated[str, AfterValidator(_uav_id)]
"""Id of one UAV in settings; a name that no UAV can have would have no effect."""


def _file_name(text: str) -> str:
    if not Path(text).name:
        raise UserError(f"{shown(text)} is not the name of a file; give one")
    return text


def _folder_name(text: str) -> str:
    if not text:
        raise UserError(f"{shown(text)} is not the name of a folder; give one, such as .")
    return text


FileName = Annotated[str, AfterValidator(_file_name)]
"""Path of a file that is written."""
FolderName = Annotated[str, AfterValidator(_folder_name)]
"""Path of a folder that is written to."""
