"""Motion capture without markers and without a body model, from the geometry alone.

Data flows one way: capture → geometry → segmentation → skeleton → files and pictures.
"""

import os
from importlib.metadata import PackageNotFoundError, version

# Threads without work sleep instead of spinning: on a machine that does other things too, spinning makes short kernels
# several times slower. Read when OpenMP is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

from geomocap.kernel_cache import configure_numba

configure_numba()

try:
    __version__ = version("geomocap")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"

__all__ = ["__version__"]
