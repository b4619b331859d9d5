"""Motion capture without markers and without a body model, from the geometry alone.

Data flows one way: capture → geometry → segmentation → skeleton → files and pictures. What stands in `__all__` is
public and stays: it changes only with a line in the changelog and a version in which the old way still works. All
functions take and return values; only those that name a folder read or write files. They are loaded when they are used
first, so that `import geomocap` is quick.

>>> import geomocap, numpy as np
>>> tracks = np.load("tracks.npy")                   # doctest: +SKIP
>>> motion = geomocap.find_motion(tracks, fps=30)    # doctest: +SKIP
"""

import importlib
import os
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

# Threads without work sleep instead of spinning: on a machine that does other things too, spinning makes short kernels
# several times slower. Read when OpenMP is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
# Frames are mapped over threads that each call parallel kernels: of Numba's layers only OpenMP allows that.
os.environ.setdefault("NUMBA_THREADING_LAYER", "omp")

try:
    __version__ = version("geomocap")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"

if TYPE_CHECKING:
    from geomocap.evaluation import evaluate
    from geomocap.export.run_export import export_run
    from geomocap.files.capture import Capture
    from geomocap.motion import Motion, MotionSettings, find_motion

_HOMES = {  # where each public name is defined
    "Capture": "geomocap.files.capture",
    "Motion": "geomocap.motion",
    "MotionSettings": "geomocap.motion",
    "evaluate": "geomocap.evaluation",
    "export_run": "geomocap.export.run_export",
    "find_motion": "geomocap.motion",
}
__all__ = [
    "Capture",
    "Motion",
    "MotionSettings",
    "__version__",
    "evaluate",
    "export_run",
    "find_motion",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'geomocap' has no attribute '{name}'")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
