"""Command-line options made from the settings models.

A setting whose field says `json_schema_extra={"flag": name}` is a flag `--name` that the help shows. Any other key is
one of the settings file; `--set TABLE.KEY=VALUE` sets it from the command line, and so does `--TABLE.KEY VALUE`. All
three are read alike, in the order in which they stand, and go before the file.
"""

from __future__ import annotations

import difflib
import functools
import inspect
import json
import tomllib
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic.fields import FieldInfo
from typer.core import TyperCommand

from geomocap.cli.arguments import Where
from geomocap.config import Config, load_config
from geomocap.errors import SettingsError
from geomocap.settings import Settings, flag_of, leaves, load_settings, read_settings

_FLAG = "flag__"
Command = Callable[..., None]
Fields = Mapping[str, FieldInfo]


def with_settings(*sections: str) -> Callable[[Command], Command]:
    """Give a command `--config FILE.toml`, `--set TABLE.KEY=VALUE` and the flags of the sections' settings.

    The command gets the merged settings as its keyword argument `config`.
    """
    fields = {key: field for key, field in leaves(Config) if key.split(".")[0] in sections}
    flags = {key: flag for key, field in fields.items() if (flag := flag_of(field)) is not None}
    return _with_options("config", fields, flags, load_config, "Settings file; a run's own run.toml repeats that run.")


def with_options_of(model: type[Settings]) -> Callable[[Command], Command]:
    """Give a command `--config FILE.toml`, `--set KEY=VALUE` and a flag `--key` for each setting of its own model.

    The command gets the merged settings as its keyword argument `settings`.
    """
    fields = dict(leaves(model))
    build = functools.partial(load_settings, model)
    return _with_options("settings", fields, {k: k for k in fields}, build, "Settings file: keys without tables.")


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
    fields: Fields,
    flags: Mapping[str, str],
    build: Callable[[Path | None, dict[str, Any]], Settings],
    file_help: str,
) -> Callable[[Command], Command]:
    def decorate(command: Command) -> Command:
        signature = inspect.signature(command, eval_str=True)
        file = Annotated[Path | None, typer.Option("--config", metavar="FILE.toml", help=file_help)]
        example = "TABLE.KEY" if all("." in key for key in fields) else "KEY"
        set_help = "Set any key of the settings file; may be repeated. docs/settings.md lists them all."
        one = Annotated[list[str] | None, typer.Option("--set", metavar=f"{example}=VALUE", help=set_help)]
        where = [p.name for p in signature.parameters.values() if p.annotation is Where]
        runs = inspect.signature(Where, eval_str=True).parameters if where else {}
        parameters = [p for p in signature.parameters.values() if p.name not in (name, *where)]
        parameters += [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in runs.values()]
        parameters += [_parameter("config_file", file), _parameter("set_values", one)]
        parameters += [_parameter(f"{_FLAG}{n}", _option(k, flags[k], fields[k])) for n, k in enumerate(flags)]

        @functools.wraps(command)
        def wrapper(**arguments: Any) -> None:
            values = _nested(arguments.pop("set_values") or (), fields)
            file = arguments.pop("config_file")
            work = Where(**{n: arguments.pop(n) for n in runs})
            given = {n: v for n, v in arguments.items() if not n.startswith(_FLAG)}
            command(**given, **dict.fromkeys(where, work), **{name: build(file, values)})

        wrapper.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
        wrapper.__annotations__ = {p.name: p.annotation for p in parameters}
        wrapper.command_class = _command_class(_SetArguments(fields, flags))  # type: ignore[attr-defined]
        return wrapper

    return decorate


def command_class(command: Command) -> type[TyperCommand]:
    """Class that reads the arguments of a command."""
    return getattr(command, "command_class", TyperCommand)


def _command_class(reader: _SetArguments) -> type[TyperCommand]:
    class SettingsCommand(TyperCommand):
        """A command whose settings all come as `--set KEY=VALUE`."""

        def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
            own = {flag for p in self.params if not str(p.name).startswith(_FLAG) for flag in p.opts}
            return super().parse_args(ctx, reader.read(args, own | {"--help"}))

    return SettingsCommand


@dataclass(frozen=True)
class _SetArguments:
    """Turns flags and `--TABLE.KEY VALUE` into `--set TABLE.KEY=VALUE`, in their order."""

    fields: Fields
    flags: Mapping[str, str]

    def read(self, arguments: Sequence[str], own: set[str]) -> list[str]:
        """Return the arguments as the command's own options `own` know them."""
        keys = {flag: key for key, flag in self.flags.items()} | {key: key for key in self.fields}
        out: list[str] = []
        waiting = iter(arguments)
        for argument in waiting:
            name, equals, value = argument.removeprefix("--").partition("=")
            if argument == "--":
                return [*out, argument, *waiting]
            if not argument.startswith("--") or f"--{name}" in own:
                out.append(argument)
                continue
            key = keys.get(name) or keys.get(name.replace("-", "_"))
            if key is None:
                self._refuse(name)
                out.append(argument)
                continue
            if not equals:
                try:
                    value = next(waiting)
                except StopIteration:
                    raise SettingsError(f"--{name} needs a value") from None
            out += ["--set", f"{key}={value}"]
        return out

    def _refuse(self, name: str) -> None:
        """Raise what helps, if an unknown flag is a key of the settings file."""
        key = name.replace("-", "_")
        found = [k for k in self.fields if k.rpartition(".")[2] == key]
        if found:
            tables = " or ".join(f"[{k.rpartition('.')[0]}]" for k in found)
            raise SettingsError(
                f"--{name} is no flag: it is the key {key} of the table {tables} in the settings file; "
                f"here it is --set {found[0]}=VALUE"
            )
        elsewhere = [k for k, field in leaves(Config) if name == flag_of(field) or key in (k, k.rpartition(".")[2])]
        if elsewhere:
            tables = " or ".join(f"[{k.rpartition('.')[0]}]" for k in elsewhere)
            raise SettingsError(f"--{name}: this command takes no settings of the table {tables}")


def _nested(given: Sequence[str], fields: Fields) -> dict[str, Any]:
    """Read `TABLE.KEY=VALUE`, each as TOML, into tables; the last one of a key holds."""
    values: dict[str, Any] = {}
    for text in given:
        key, equals, value = text.partition("=")
        key = key.strip()
        if not equals:
            raise SettingsError(f"--set {text}: expected TABLE.KEY=VALUE")
        if key not in fields:
            near = difflib.get_close_matches(key, fields, 1)
            advice = f"; did you mean {near[0]}?" if near else "; docs/settings.md lists them all"
            raise SettingsError(f"--set {text}: this command has no setting {key}{advice}")
        *tables, last = key.split(".")
        table = values
        for part in tables:
            table = table.setdefault(part, {})
        table[last] = _parse(value.strip(), fields[key].annotation)
    return values


def _parameter(name: str, annotation: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)


def _option(key: str, flag: str, field: FieldInfo) -> Any:
    default = field.get_default(call_default_factory=True)
    table, _, last = key.rpartition(".")
    return Annotated[
        str | None,
        typer.Option(
            f"--{flag}",
            metavar=_type_name(field.annotation),
            help=field.description or last.replace("_", " "),
            show_default="none" if default is None else json.dumps(default).strip('"'),
            rich_help_panel=f"Settings: {table.split('.')[0]}" if table else "Settings",
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


def _parse(text: str, annotation: Any) -> Any:
    """Read a value as TOML does; what isn't TOML, and an unquoted word where one is expected, is a string."""
    if text in typing.get_args(annotation) or (annotation in (str, str | None) and text[:1] not in "\"'"):
        return text
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text
