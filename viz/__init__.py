"""Pictures out: offscreen renderings, plots, videos, the report page.

Everything is rendered by casting rays with Open3D (Embree), so neither a screen nor a graphics stack is needed.
"""

import geomocap as geomocap  # it says where compiled kernels are kept, before there are any
from viz.picture_files import render_file
from viz.review import review

__all__ = ["render_file", "review"]
