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
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parent.parent
OTHERS = "api/others.md"
_EQUATION = re.compile(r'<(div|span) class="arithmatex">\\[\[(](.*?)\\[\])]</\1>', re.DOTALL)
_NAME = re.compile(r"(?<!\[)`(geomocap\.(\w+)[\w.]*)`")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """List the API's rooms in the navigation."""
    pages = [{"geomocap": "api.md"}, *({room: f"api/{room}.md"} for room in rooms()), {"other modules": OTHERS}]
    config.nav = [{"API": pages} if entry == {"API": "api.md"} else entry for entry in config.nav or []]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made from sources: the rooms and the changelog."""
    made = {f"api/{room}.md": room_page(room) for room in rooms()} | {OTHERS: others_page()}
    made["changelog.md"] = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").replace("](docs/", "](")
    for name, text in made.items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Let the pages' names of rooms, modules and functions lead to their place in the API."""
    if page.file.src_uri.startswith("api/"):
        return markdown
    up = "../" * page.file.src_uri.count("/")
    known = {*_modules(ROOT / "geomocap"), *_public()}

    def link(name: re.Match[str]) -> str:
        room = name[2] in rooms()
        if room and name[1] == f"geomocap.{name[2]}":
            return f"[`{name[1]}`]({up}api/{name[2]}.md)"
        return f"[`{name[1]}`][{name[1]}]" if room or name[2] in known else name[0]

    return _NAME.sub(link, markdown)


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
    return _page(f"geomocap.{room}", purpose, [f"geomocap.{room}.{module}" for module in _modules(folder)])


def others_page() -> str:
    """Write the API page of the modules that are in no room."""
    return _page("Other modules", "Modules that all rooms use.", [f"geomocap.{m}" for m in _modules(ROOT / "geomocap")])


def _page(title: str, purpose: str, modules: list[str]) -> str:
    parts = [f"# {title}", purpose]
    parts += [f"::: {module}\n    options:\n      heading_level: 2" for module in modules]
    return "\n\n".join(parts) + "\n"


def _modules(folder: Path) -> list[str]:
    return sorted(p.stem for p in folder.glob("*.py") if not p.stem.startswith("_"))


def _public() -> list[str]:
    tree = ast.parse((ROOT / "geomocap" / "__init__.py").read_text(encoding="utf-8"))
    lists = [n.value for n in tree.body if isinstance(n, ast.Assign) and ast.unparse(n.targets[0]) == "__all__"]
    return [name for name in ast.literal_eval(lists[0]) if not name.startswith("_")]
