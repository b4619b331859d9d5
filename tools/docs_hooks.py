"""What the pages need beyond Markdown: equations without scripts, an API page for each room, the changelog.

MkDocs calls these functions by their names (`hooks` in `mkdocs.yml`). Everything happens when the pages are built, and
nothing is fetched, then or by the reader.
"""

from __future__ import annotations

import ast
import html
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parent.parent
_EQUATION = re.compile(r'<(div|span) class="arithmatex">\\[\[(](.*?)\\[\])]</\1>', re.DOTALL)
_GENERATED = {
    "settings.md": "# Settings\n\n`geomocap run --help` lists the settings with units, meanings and defaults.\n",
}


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """List the API's rooms in the navigation."""
    pages = [{"geomocap": "api.md"}, *({room: f"api/{room}.md"} for room in rooms())]
    config.nav = [{"API": pages} if entry == {"API": "api.md"} else entry for entry in config.nav or []]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made from sources: the rooms, the changelog; generated ones that aren't there yet."""
    made = {f"api/{room}.md": room_page(room) for room in rooms()}
    made["changelog.md"] = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    made |= {name: text for name, text in _GENERATED.items() if files.get_file_from_path(name) is None}
    for name, text in made.items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_content(content: str, **_: Any) -> str:
    """Turn equations into MathML, which browsers draw by themselves."""

    def mathml(match: re.Match[str]) -> str:
        display = "block" if match[1] == "div" else "inline"
        return convert(html.unescape(match[2].strip()), display=display)

    return _EQUATION.sub(mathml, content)


def rooms() -> list[str]:
    """List the packages of geomocap that have modules with public names."""
    folders = sorted(p.parent for p in (ROOT / "geomocap").glob("*/__init__.py"))
    return [folder.name for folder in folders if folder.name != "cli" and _modules(folder)]


def room_page(room: str) -> str:
    """Write the API page of a room: its purpose, then every module with what it offers."""
    folder = ROOT / "geomocap" / room
    purpose = ast.get_docstring(ast.parse((folder / "__init__.py").read_text(encoding="utf-8"))) or ""
    parts = [f"# geomocap.{room}", purpose]
    parts += [f"::: geomocap.{room}.{module}\n    options:\n      heading_level: 2" for module in _modules(folder)]
    return "\n\n".join(parts) + "\n"


def _modules(folder: Path) -> list[str]:
    return sorted(p.stem for p in folder.glob("*.py") if not p.stem.startswith("_"))
