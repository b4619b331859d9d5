"""Base of all settings: frozen pydantic models in which an unknown key is an error."""

from __future__ import annotations

from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from geomocap.errors import SettingsError

Model = TypeVar("Model", bound="Settings")


class Settings(BaseModel):
    """Settings of one stage. Each field has a default that works and a description with its unit.

    Every stage keeps its model beside its code; `geomocap.config` nests them into one TOML file.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def check_settings(model: type[Model], values: dict[str, Any], where: str = "") -> Model:
    """Make settings from plain values.

    Parameters
    ----------
    model : type of Settings
    values : dict
        Nested as the model is.
    where : str
        File that the values come from, for the message.

    Raises
    ------
    SettingsError
        Naming the first key that is unknown, of the wrong type or out of range.
    """
    try:
        return model(**values)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(p) for p in first["loc"]) or "(all)"
        start = f"{where}: " if where else ""
        if first["type"] == "extra_forbidden":
            raise SettingsError(f"{start}unknown setting {key}; --help of the command lists them all") from None
        if not first["loc"]:
            raise SettingsError(f"{start}{first['msg'].removeprefix('Value error, ')}") from None
        raise SettingsError(f"{start}setting {key} = {first['input']!r}: {first['msg']}") from None
