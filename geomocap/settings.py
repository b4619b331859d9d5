"""Base of all settings: frozen pydantic models in which an unknown key is an error."""

from __future__ import annotations

from collections.abc import Iterator
from numbers import Real
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, ValidationError, ValidationInfo, field_validator
from pydantic.fields import FieldInfo
from pydantic_core import PydanticCustomError

from geomocap.errors import SettingsError
from geomocap.reading import check_entries, read_toml, shortened

Model = TypeVar("Model", bound="Settings")
MOST_COUNTED, MOST_MEASURED = 10_000_000, 1e9  # of any setting: things counted, and metres, pixels, degrees
LEAST_FPS, MOST_FPS = 0.001, 1e6  # from one picture in a quarter of an hour to the fastest cameras


class Settings(BaseModel):
    """Settings of one stage. Each field has a default that works and a description with its unit.

    Every stage keeps its model beside its code; `geomocap.config` nests them into one TOML file. A field's
    `json_schema_extra` may hold "flag", a name under which the command line shows it, and "evidence", what was measured
    with other values.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _truth_is_no_number(cls, value: Any, info: ValidationInfo) -> Any:
        """Refuse true and false for numbers, also within lists; Python would take them as 1 and 0."""
        types = _types(cls.model_fields[str(info.field_name)].annotation)
        if types & {int, float} and bool not in types and _holds_truth(value):
            raise PydanticCustomError("truth_for_number", "must be a number, not true or false")
        return value

    @field_validator("*")
    @classmethod
    def _within_reason(cls, value: Any) -> Any:
        """Refuse numbers that nothing in a recording has: they would only take all memory, or all time."""
        for number in _numbers(value):
            most = MOST_COUNTED if isinstance(number, int) else MOST_MEASURED
            if abs(number) > most:
                raise PydanticCustomError(
                    "beyond_reason", "must lie between {least} and {most}", {"least": -most, "most": most}
                )
        return value


def _numbers(value: Any) -> Iterator[int | float]:
    if isinstance(value, list | tuple):
        for item in value:
            yield from _numbers(item)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield value


def _types(annotation: Any) -> set[Any]:
    """Return a type, or those that a union or a tuple is made of."""
    parts = get_args(annotation)
    return set[Any]().union(*map(_types, parts)) if parts else {annotation}


def _holds_truth(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return any(map(_holds_truth, value))
    return isinstance(value, bool)


def leaves(model: type[BaseModel], table: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """List the single settings of a model, nested ones too, with their dotted keys."""
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from leaves(field.annotation, f"{table}{name}.")
        else:
            yield f"{table}{name}", field


def flag_of(field: FieldInfo) -> str | None:
    """Name of a setting's flag on the command line; None if it is a key of the settings file only."""
    extra = field.json_schema_extra
    return str(extra["flag"]) if isinstance(extra, dict) and "flag" in extra else None


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
        key = shortened(".".join(str(p) for p in first["loc"]))
        start = f"{where}: " if where else ""
        if first["type"] == "extra_forbidden":
            known = ", ".join(_table(model, first["loc"]).model_fields)
            raise SettingsError(f"{start}unknown setting {key}; known there are {known}") from None
        given = f"setting {key} = {shortened(repr(first['input']))}: " if key else ""
        raise SettingsError(f"{start}{given}{_plain(first['msg'])}") from None


def _table(model: type[BaseModel], place: tuple[int | str, ...]) -> type[BaseModel]:
    """Return the model of the table, or of the tables in a list, that a key stands in."""
    for part in place[:-1]:
        if part in model.model_fields:
            parts = _types(model.model_fields[str(part)].annotation)
            model = next((t for t in parts if isinstance(t, type) and issubclass(t, BaseModel)), model)
    return model


def check_fps(fps: float) -> None:
    """Refuse frames per second that no recording has, and what is no number; raises SettingsError."""
    if isinstance(fps, bool) or not isinstance(fps, Real) or not LEAST_FPS <= float(fps) <= MOST_FPS:
        given = shortened(repr(fps))
        raise SettingsError(f"fps = {given}: expected {LEAST_FPS:g} to {MOST_FPS:,.0f} frames per second")


def explained(error: ValidationError) -> str:
    """Say of the first wrong value of a file which key it is and what was expected."""
    first = error.errors()[0]
    key = shortened(".".join(str(p) for p in first["loc"]))
    return f"{key}: {_plain(first['msg'])}" if key else _plain(first["msg"])


def _plain(message: str) -> str:
    """Word a message of pydantic as ours are."""
    message = message.removeprefix("Value error, ").replace("Input should be", "must be")
    return {"Field required": "is missing", "Extra inputs are not permitted": "no such key"}.get(message, message)


def load_settings(model: type[Model], path: Path | None = None, overrides: dict[str, Any] | None = None) -> Model:
    """Read settings from a TOML file, override single keys, and check them all.

    Parameters
    ----------
    model : subclass of Settings
    path : Path, optional
        A settings file, or the `run.toml` of a run that is to be repeated.
    overrides : dict, optional
        Nested as the file is.

    Raises
    ------
    SettingsError
        If the file can't be read, a key is unknown or a value out of range.
    """
    values = {} if path is None else read_settings(path)
    if {"config", "geomocap"} <= values.keys() and isinstance(values["config"], dict):  # a run.toml
        check_entries(values, path or Path(), SettingsError, "take another, or remove that line if it is meant so")
        values = values["config"]
    return check_settings(model, _merge(values, overrides or {}), str(path) if path is not None else "")


def read_settings(path: Path) -> dict[str, Any]:
    """Read a settings file as it is; raises SettingsError if it isn't TOML or can't be read."""
    return read_toml(path, SettingsError)


def _merge(values: dict[str, Any], overrides: dict[str, Any]) -> dict[str, Any]:
    """Return nested tables with those of `overrides` put over them."""
    merged = dict(values)
    for key, value in overrides.items():
        below = merged.get(key)
        merged[key] = _merge(below, value) if isinstance(value, dict) and isinstance(below, dict) else value
    return merged
