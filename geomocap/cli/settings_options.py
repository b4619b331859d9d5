"""Command-line options made from the settings models: each key of the TOML file is a flag `--section.key`.

A setting whose field has `json_schema_extra={"flag": name}` is a flag `--name` as well.
"""

from __future__ import annotations

import functools
import inspect
import json
import tomllib
import types
import typing
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from geomocap.config import Config, load_config
from geomocap.errors import SettingsError
from geomocap.settings import Settings, load_settings, read_settings

_PREFIX, _SEPARATOR = "set__", "__"
Command = Callable[..., None]


def with_settings(*sections: str) -> Callable[[Command], Command]:
    """Give a command `--config FILE.toml` and a flag `--section.key` for each setting of the sections.

    The command gets the merged settings as its keyword argument `config`.
    """
    fields = [(path, field) for path, field in _leaves(Config, ()) if path[0] in sections]
    return _with_options("config", fields, load_config, "Settings file; a run's own run.toml repeats that run.")


def with_options_of(model: type[Settings]) -> Callable[[Command], Command]:
    """Give a command `--config FILE.toml` and a flag `--key` for each setting of a model.

    The command gets the merged settings as its keyword argument `settings`.
    """
    build = functools.partial(load_settings, model)
    return _with_options("settings", list(_leaves(model, ())), build, "Settings file: keys as below, without tables.")


def with_file_of_options(command: Command) -> Command:
    """Give a command without settings `--config FILE.toml`: the file's keys are the command's own options."""
    signature = inspect.signature(command, eval_str=True)
    option = typer.Option(
        "--config",
        metavar="FILE.toml",
        help="Settings file: keys are the options here, without the dashes before them.",
        is_eager=True,
        callback=_read_options,
    )
    parameters = [*signature.parameters.values(), _parameter("config_file", Annotated[Path | None, option])]

    @functools.wraps(command)
    def wrapper(config_file: Path | None = None, **arguments: Any) -> None:
        command(**arguments)

    wrapper.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    wrapper.__annotations__ = {p.name: p.annotation for p in parameters}
    return wrapper


def _read_options(context: typer.Context, file: Path | None) -> Path | None:
    """Take the defaults of a command's options from a file."""
    if file is None:
        return None
    named = {flag.lstrip("-"): p.name for p in context.command.params for flag in p.opts if flag.startswith("--")}
    expected = sorted(named.keys() - {"config", "help"})
    values = read_settings(file)
    for key in values:
        if key not in expected:
            raise SettingsError(f"{file}: unknown setting {key}; expected {', '.join(expected)}")
    context.default_map = {str(named[key]): value for key, value in values.items()}
    return file


def _with_options(
    name: str,
    fields: Sequence[tuple[tuple[str, ...], FieldInfo]],
    build: Callable[[Path | None, dict[str, Any]], Settings],
    file_help: str,
) -> Callable[[Command], Command]:
    def decorate(command: Command) -> Command:
        signature = inspect.signature(command, eval_str=True)
        parameters = [p for p in signature.parameters.values() if p.name != name]
        file = Annotated[Path | None, typer.Option("--config", metavar="FILE.toml", help=file_help)]
        parameters.append(_parameter("config_file", file))
        parameters += [_parameter(_PREFIX + _SEPARATOR.join(path), _option(path, field)) for path, field in fields]

        @functools.wraps(command)
        def wrapper(**arguments: Any) -> None:
            values: dict[str, Any] = {}
            for argument in [n for n in arguments if n.startswith(_PREFIX)]:
                text = arguments.pop(argument)
                if text is not None:
                    *tables, key = argument.removeprefix(_PREFIX).split(_SEPARATOR)
                    table = values
                    for part in tables:
                        table = table.setdefault(part, {})
                    table[key] = _parse(text)
            arguments[name] = build(arguments.pop("config_file"), values)
            command(**arguments)

        wrapper.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
        wrapper.__annotations__ = {p.name: p.annotation for p in parameters}
        return wrapper

    return decorate


def _parameter(name: str, annotation: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)


def _leaves(model: type[BaseModel], path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], FieldInfo]]:
    """List the single settings below a model with their paths."""
    for key, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from _leaves(field.annotation, (*path, key))
        else:
            yield (*path, key), field


def _option(path: tuple[str, ...], field: FieldInfo) -> Any:
    default = field.get_default(call_default_factory=True)
    extra = field.json_schema_extra
    short = [f"--{extra['flag']}"] if isinstance(extra, dict) and "flag" in extra else []
    return Annotated[
        str | None,
        typer.Option(
            f"--{'.'.join(path)}",
            *short,
            metavar=_type_name(field.annotation),
            help=field.description or path[-1].replace("_", " "),
            show_default="none" if default is None else json.dumps(default).strip('"'),
            rich_help_panel=f"Settings: {path[0]}" if len(path) > 1 else "Settings",
        ),
    ]


def _type_name(annotation: Any) -> str:
    """Name a type as help texts show it."""
    origin = typing.get_origin(annotation)
    if origin is typing.Literal:
        return "|".join(str(a) for a in typing.get_args(annotation))
    if origin in (types.UnionType, typing.Union):
        return "|".join(_type_name(a) for a in typing.get_args(annotation) if a is not type(None))
    if origin is tuple:
        return "[" + ", ".join(_type_name(a) for a in typing.get_args(annotation) if a is not ...) + "]"
    return {int: "INT", float: "NUMBER", bool: "true|false", str: "TEXT", Path: "PATH"}.get(annotation, "VALUE")


def _parse(text: str) -> Any:
    """Read a value as TOML does; what isn't TOML is a string."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
