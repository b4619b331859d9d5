"""What the sources do, as digests: comments, docstrings, descriptions of settings and the places of lines left out.

Results and compiled kernels depend on code that is spread over modules. Digests of it say when they are out of date.
"""

from __future__ import annotations

import ast
import hashlib
import json
import sys
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import CodeType
from typing import Any

from geomocap.kernel_cache import cache_folder, files_digest, write_note

ROOT = Path(__file__).parent.parent
PACKAGES = ("geomocap", "data_tools", "viz")

# Settings stand in a stage's key by their values, and all tables of them in one module: following that would tie each
# stage to the settings of all others. What the package itself offers is no part of a stage either.
NOT_FOLLOWED = frozenset({"geomocap", "geomocap.config"})

_DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


@cache
def module_digest(module: str) -> str:
    """Digest of a module and of all modules of the project that it imports, directly or through others.

    Parameters
    ----------
    module : str
        Such as `geomocap.pipeline.voxel_stage`.

    Raises
    ------
    ModuleNotFoundError
        If it is no module of the project.
    """
    digest = hashlib.blake2b(digest_size=16)
    behind = sorted(modules_behind(module))
    for name in behind:
        digest.update(f"{name} {_module_code(name)[0]}\n".encode())
    _note(behind)
    return digest.hexdigest()


def modules_behind(module: str) -> set[str]:
    """Names of a module and of all modules of the project that it imports, directly or through others."""
    found: set[str] = set()
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name not in found:
            found.add(name)
            waiting += _module_code(name)[1] - NOT_FOLLOWED
    return found


@cache
def _module_code(module: str) -> tuple[str, frozenset[str]]:
    """Digest of a module's own code, and the modules of the project that it imports."""
    if module in _noted():
        digest, imports = _noted()[module]
        return digest, frozenset(imports)
    file = module_file(module)
    if file is None:
        raise ModuleNotFoundError(f"{module} is no module of geomocap")
    tree = ast.parse(file.read_bytes())
    package = module if file.name == "__init__.py" else module.rpartition(".")[0]
    return code_digest(tree), frozenset(imported_modules(tree, package))


@cache
def _noted() -> dict[str, tuple[str, list[str]]]:
    """What was found of modules when the sources were as they are now: compiling them all takes two seconds."""
    try:
        return dict(json.loads(_note_file().read_bytes()))
    except (OSError, ValueError, TypeError):
        return {}


def _note(modules: list[str]) -> None:
    """Keep what was found of modules, for the next process."""
    if not _noted().keys() >= set(modules):
        for name in modules:
            digest, imports = _module_code(name)
            _noted()[name] = digest, sorted(imports)
        with suppress(OSError):
            write_note(_note_file(), json.dumps(_noted()))


@cache
def _note_file() -> Path:
    """File for the sources as they are now and this Python; raises OSError if there is no place for it."""
    folder = cache_folder()
    if folder is None:
        raise OSError("nothing can be written anywhere")
    python = f"{sys.implementation.cache_tag}-{sys.hexversion:x}"
    return folder.parent / f"{files_digest(ROOT)}-{python}.json"


def module_file(module: str) -> Path | None:
    """File of a module of the project; None if there is none."""
    parts = module.split(".")
    if parts[0] not in PACKAGES:
        return None
    place = ROOT.joinpath(*parts)
    return next((f for f in (place.with_suffix(".py"), place / "__init__.py") if f.is_file()), None)


def imported_modules(tree: ast.AST, package: str) -> Iterator[str]:
    """Modules of the project that a source imports, anywhere in it."""
    for node in _statements(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            up = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            source = ".".join([*up, *filter(None, [node.module])])
            inside = [f"{source}.{alias.name}" for alias in node.names]
            names = [name if module_file(name) else source for name in inside]
        else:
            continue
        yield from (name for name in names if module_file(name))


def _statements(node: ast.AST) -> Iterator[ast.stmt]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.stmt):
            yield child
        if isinstance(child, ast.stmt | ast.ExceptHandler | ast.match_case):
            yield from _statements(child)


def code_digest(tree: ast.Module) -> str:
    """Digest of what a source does: of its byte code without docstrings and line numbers."""
    for node in ast.walk(tree):
        if isinstance(node, ast.keyword) and node.arg in ("description", "json_schema_extra"):
            node.value = ast.copy_location(ast.Constant(None), node.value)
        elif isinstance(node, _DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            node.body = node.body[1:] or [ast.copy_location(ast.Pass(), node.body[0])]
    digest = hashlib.blake2b(digest_size=16)
    digest.update(repr(_said(compile(tree, "", "exec", dont_inherit=True, optimize=0))).encode())
    return digest.hexdigest()


def _said(value: Any) -> Any:
    """Return a constant or code as a value whose text is the same in every process."""
    if isinstance(value, CodeType):
        names = (value.co_name, value.co_names, value.co_varnames, value.co_freevars, value.co_cellvars)
        counts = (value.co_argcount, value.co_posonlyargcount, value.co_kwonlyargcount, value.co_flags)
        return names, counts, value.co_code, value.co_exceptiontable, [_said(c) for c in value.co_consts]
    if isinstance(value, frozenset):
        return sorted(map(repr, value))
    return value
