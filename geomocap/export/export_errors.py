"""What can go wrong with motion files, and packages that only some formats need."""

from __future__ import annotations

import importlib
from types import ModuleType

from geomocap.errors import GeomocapError


class MotionError(GeomocapError):
    """A motion or a motion file that can't be read, written or compared."""


class MissingPackageError(MotionError):
    """A format needs a package that isn't installed."""


def require(package: str, *, extra: str, purpose: str) -> ModuleType:
    """Import a package that only some formats need.

    Parameters
    ----------
    package : str
        Name to import.
    extra : str
        The extra of geomocap that installs it.
    purpose : str
        What it is for, e.g. "C3D files".

    Raises
    ------
    MissingPackageError
        If it isn't installed; the line says how to install it.
    """
    try:
        return importlib.import_module(package)
    except ImportError:
        raise MissingPackageError(
            f'{purpose} need the package {package.split(".")[0]}; install it with: pip install "geomocap[{extra}]"'
        ) from None
