"""Where compiled kernels are kept: a folder for each state of all kernels' sources.

Numba compiles a kernel anew when the kernel's own file has changed, but not when a kernel in another file that it calls
has. So the folder of its cache is named by a digest of all kernels and of the constants that they use: what is found in
it was compiled from just these sources. Edits elsewhere, of comments and of docstrings leave the digest as it is.
"""

from __future__ import annotations

import ast
import hashlib
import os
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGES = ("geomocap", "data_tools", "viz")

_CHOSEN = "GEOMOCAP_KERNEL_CACHE"  # tells programs that are started from here which folder we chose, not the user
_KEPT = 4
_DAY = 86400.0  # s; folders in use since then are kept in any case


def configure_numba() -> None:
    """Tell Numba where to keep compiled kernels, and which threads to use; call it before kernels are made.

    Numba itself is not imported. A folder that the user has set (`NUMBA_CACHE_DIR`) gets a sub-folder.
    """
    folder = cache_folder()
    numba = sys.modules.get("numba")
    if numba is not None:  # it has read the environment already
        numba.config.THREADING_LAYER = "omp"
        if folder is not None:
            numba.config.CACHE_DIR = str(folder)
        return
    # Frames are mapped over threads that each call parallel kernels: of Numba's layers only OpenMP allows that.
    os.environ["NUMBA_THREADING_LAYER"] = "omp"
    if folder is not None:
        os.environ["NUMBA_CACHE_DIR"] = os.environ[_CHOSEN] = str(folder)


def cache_folder() -> Path | None:
    """Make and return the folder of the kernels as their sources are now; None if nothing can be written anywhere."""
    for base in _places():
        try:
            base.mkdir(parents=True, exist_ok=True)
            folder = base / _digest(base)
            if not folder.is_dir():
                folder.mkdir(exist_ok=True)
                _tidy(base)
            os.utime(folder)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    return None


def _places() -> Iterator[Path]:
    """Where the cache may be, best first."""
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given:
        yield Path(given).parent if given == os.environ.get(_CHOSEN) else Path(given) / "geomocap"
    with suppress(RuntimeError):  # no home
        yield _user_cache() / "geomocap" / "kernels"
    yield Path(__file__).parent / "__pycache__" / "kernels"
    if hasattr(os, "getuid"):
        yield from _own_temporary()


def _user_cache() -> Path:
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def _own_temporary() -> Iterator[Path]:
    """A temporary folder, if nobody else can put kernels there: what is read from it is executed."""
    import tempfile

    own = Path(tempfile.gettempdir()) / f"geomocap-kernels-{os.getuid()}"
    with suppress(OSError):
        own.mkdir(mode=0o700, exist_ok=True)
        stat = own.lstat()
        if stat.st_uid == os.getuid() and not own.is_symlink() and not stat.st_mode & 0o077:
            yield own


def _digest(base: Path) -> str:
    """Digest of the kernels; the sources are parsed once for each state of their files, and the answer kept."""
    note = base / f"{files_digest(ROOT)}.txt"
    try:
        return note.read_text()
    except OSError:
        digest = kernels_digest(ROOT)
        with suppress(OSError):
            write_note(note, digest)
        return digest


def write_note(file: Path, text: str) -> None:
    """Write a small file beside the kernels, whole or not at all; raises OSError if it can't be written."""
    temporary = file.with_name(f".{file.name}.{os.getpid()}")
    temporary.write_text(text)
    os.replace(temporary, file)


def files_digest(root: Path) -> str:
    """Digest of the names and contents of all sources below a folder's packages."""
    digest = hashlib.blake2b(digest_size=16)
    for name in _sources(root):
        with open(os.path.join(root, name), "rb") as file:
            digest.update(hashlib.blake2b(name.encode() + b"\0" + file.read()).digest())
    return digest.hexdigest()


def _sources(root: Path) -> list[str]:
    """Names of all sources below a folder's packages, sorted."""
    found: list[str] = []
    waiting = [p for p in PACKAGES if (root / p).is_dir()]
    while waiting:
        folder = waiting.pop()
        with os.scandir(root / folder) as entries:
            for entry in entries:
                if entry.name.endswith(".py"):
                    found.append(f"{folder}/{entry.name}")
                elif entry.is_dir() and entry.name != "__pycache__":
                    waiting.append(f"{folder}/{entry.name}")
    return sorted(found)


def kernels_digest(root: Path) -> str:
    """Digest of all kernels in the packages below a folder, and of the constants that they use, wherever they stand."""
    texts = {name: (root / name).read_bytes() for name in _sources(root)}
    trees = {name: ast.parse(text) for name, text in texts.items() if b"njit" in text}
    kernels = {name: [n for n in trees[name].body if _is_kernel(n)] for name in trees}
    used = {name: {word for kernel in kernels[name] for word in _words(kernel)} for name in trees}
    said = {f"{name} {_said(kernel)}" for name in kernels for kernel in kernels[name]}
    waiting = list(trees)
    while waiting:
        name = waiting.pop()
        tree = trees[name] if name in trees else trees.setdefault(name, ast.parse(texts[name]))
        for node in _constants(tree, used[name]):
            said.add(f"{name} {ast.dump(node)}")
        for source, words in _imported(tree, used[name]):
            if source in texts and not words <= used.setdefault(source, set()):
                used[source] |= words
                waiting.append(source)
    return hashlib.blake2b("\n".join(sorted(said)).encode(), digest_size=12).hexdigest()


def _is_kernel(node: ast.stmt) -> bool:
    return isinstance(node, ast.FunctionDef) and bool(node.decorator_list)


def _words(node: ast.AST) -> Iterator[str]:
    """Names that a piece of code uses."""
    for part in ast.walk(node):
        if isinstance(part, ast.Name):
            yield part.id
        elif isinstance(part, ast.Attribute):
            yield part.attr


def _said(kernel: ast.stmt) -> str:
    """Text of a kernel without its docstring."""
    assert isinstance(kernel, ast.FunctionDef)
    body = kernel.body[ast.get_docstring(kernel) is not None :]
    return " ".join(ast.dump(part) for part in (kernel.args, *kernel.decorator_list, *body)) + kernel.name


def _constants(tree: ast.Module, used: set[str]) -> list[ast.stmt]:
    """Assignments at the top of a module to the names `used`; names that these use are added."""
    found: list[ast.stmt] = []
    assignments = [n for n in tree.body if isinstance(n, ast.Assign | ast.AnnAssign)]
    more = True
    while more:
        new = [n for n in assignments if n not in found and used & set(_targets(n))]
        used.update(word for node in new for word in _words(node))
        found += new
        more = bool(new)
    return found


def _targets(node: ast.Assign | ast.AnnAssign) -> Iterator[str]:
    for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
        yield from _words(target)


def _imported(tree: ast.Module, used: set[str]) -> Iterator[tuple[str, set[str]]]:
    """Sources that a module imports some of the names `used` from, and these names."""
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            source = node.module.replace(".", "/")
            yield f"{source}.py", {alias.name for alias in node.names if (alias.asname or alias.name) in used}
            for alias in node.names:
                if (alias.asname or alias.name) in used:  # a module whose constants are used by its name
                    yield f"{source}/{alias.name}.py", used


def _tidy(base: Path) -> None:
    """Delete the folders of older sources beyond a few, and what was noted of older sources."""
    last_day = time.time() - _DAY
    folders = sorted((p for p in base.iterdir() if p.is_dir()), key=_age)
    for folder in folders[_KEPT:]:
        if -_age(folder) < last_day:
            shutil.rmtree(folder, ignore_errors=True)
    for kind in ("*.txt", "*.json"):
        for note in sorted(base.glob(kind), key=_age)[8 * _KEPT :]:
            with suppress(OSError):
                note.unlink()


def _age(path: Path) -> float:
    try:
        return -path.stat().st_mtime
    except OSError:  # another process has just deleted it
        return 0.0
