"""Writes docs/settings.md, all settings with their meaning, from the models: `python -m tools.settings_page`."""

from __future__ import annotations

import inspect
import json
import re
import sys
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from data_tools.synthesize import SynthesisSettings
from geomocap.calibration.calibration_settings import BarSettings
from geomocap.config import Config
from geomocap.evaluation.evaluation_settings import EvaluationSettings
from geomocap.settings import flag_of, leaves

PAGE = Path(__file__).parent.parent / "docs" / "settings.md"

START = """# Settings

Written from the code by `make settings`; changes belong there.

All settings have defaults that work. Others come from

1. a settings file, `--config FILE.toml`: a TOML file with the tables and keys below. The `run.toml` of a run is one,
   too, and repeats that run;
2. the command line, which goes before the file: flags for what is set most, `--set TABLE.KEY=VALUE` for any key, such
   as `--set carving.hull.tolerance=1`. Values are written as in TOML, words without quotes.

```toml
[carving]
resolution = 192

[carving.hull]
outside = "empty"
```

An unknown key is an error. A stage is done again when a setting that it depends on has changed.
"""

BOUNDS = {"ge": "≥ {}", "gt": "> {}", "le": "≤ {}", "lt": "< {}", "min_length": "at least {} of them"}
UNITS = re.compile(
    r"\((m|m/s|m/s²|s|px|px²|pixels.*|degrees.*|frames?.*|metres.*|grey .*|points.*|(?:equivalent length, )?.*spacings|"
    r"scan units|count|ratio.*|0.*1|no unit|fraction.*|diagonals.*|noise sigmas|standard dev.*|log ratio|times .*)\)"
)


def page() -> str:
    """Text of the page."""
    parts = [START, _table_of_flags()]
    for name, field in Config.model_fields.items():
        parts += _tables(typing.cast(type[BaseModel], field.annotation), f"[{name}]", field.description or "", True)
    parts.append("# Settings of single commands\n\nThese have keys of their own, each a flag `--key` as well.\n")
    own: dict[str, type[BaseModel]] = {
        "calibrate": BarSettings,
        "evaluate": EvaluationSettings,
        "synthesize": SynthesisSettings,
    }
    for command, model in own.items():
        parts += _tables(model, f"geomocap {command}", "", False)
    return "\n".join(parts)


def _table_of_flags() -> str:
    rows = [f"| `--{flag}` | `{key}` |" for key, field in leaves(Config) if (flag := flag_of(field)) is not None]
    return "\n".join(["## Flags", "", "| flag | key |", "|---|---|", *rows, ""])


def _tables(model: type[BaseModel], title: str, what: str, flags: bool) -> Iterator[str]:
    """Sections of a model and of those nested in it."""
    said = inspect.getdoc(model) or ""
    first, _, more = said.partition("\n")
    single = {k: f for k, f in model.model_fields.items() if not _is_model(f)}
    yield f"## {title}{': ' + what if what else ''}\n\n{first}\n"
    if more.strip():
        yield f"```text\n{more.strip()}\n```\n"
    if single:
        yield "| key | default | unit | range | meaning |" + (" flag |" if flags else "")
        yield "|---|---|---|---|---|" + ("---|" if flags else "")
        yield from (_row(key, field, flags) for key, field in single.items())
        yield ""
    evidence = {k: _extra(f).get("evidence") for k, f in single.items()}
    if any(evidence.values()):
        yield "\n".join(["Measured:", "", *(f"- `{key}`: {text}" for key, text in evidence.items() if text), ""])
    for key, field in model.model_fields.items():
        if _is_model(field):
            inner = f"{title[:-1]}.{key}]" if flags else f"{title}: table [{key}]"
            yield from _tables(typing.cast(type[BaseModel], field.annotation), inner, field.description or "", flags)


def _row(key: str, field: FieldInfo, flags: bool) -> str:
    default = field.get_default(call_default_factory=True)
    meaning, unit = _meaning(field)
    shown = "" if default is None else f"`{json.dumps(default)}`"
    cells = [f"`{key}`", shown, unit, _range(field), meaning]
    if flags:
        flag = flag_of(field)
        cells.append(f"`--{flag}`" if flag else "")
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _meaning(field: FieldInfo) -> tuple[str, str]:
    """Description of a setting without its unit, and the unit."""
    text = (field.description or "").rstrip(".")
    found = list(UNITS.finditer(text))
    if found:
        return (text[: found[0].start()].rstrip() + text[found[0].end() :]), found[0].group(1)
    kinds = _kinds(field.annotation)
    if _choices(field.annotation) or not kinds & {int, float} or re.search("seed of|random numbers", text):
        return text, ""
    return text, "no unit" if float in kinds else "count"


def _range(field: FieldInfo) -> str:
    words = [str(value) for value in _choices(field.annotation)]
    if words:
        return ", ".join(f"`{word}`" for word in words)
    if bool in _kinds(field.annotation):
        return "`true`, `false`"
    limits = [(name, getattr(data, name)) for data in field.metadata for name in BOUNDS if hasattr(data, name)]
    return ", ".join(BOUNDS[name].format(f"{value:g}") for name, value in limits)


def _choices(annotation: Any) -> tuple[Any, ...]:
    return typing.get_args(annotation) if typing.get_origin(annotation) is typing.Literal else ()


def _kinds(annotation: Any) -> set[Any]:
    inner = typing.get_args(annotation)
    return set[Any]().union(*map(_kinds, inner)) if inner else {annotation}


def _is_model(field: FieldInfo) -> bool:
    return isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)


def _extra(field: FieldInfo) -> dict[str, Any]:
    return field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}


def main() -> None:
    """Write the page, or with `--check` say whether it is up to date."""
    if "--check" in sys.argv:
        if PAGE.read_text(encoding="utf-8") != page():
            sys.exit(f"{PAGE} is out of date: make settings")
        return
    PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
