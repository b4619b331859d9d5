"""Motion capture without markers and without a body model, from the geometry alone.

Data flows one way: capture → geometry → segmentation → skeleton → files and pictures. What stands in `__all__` is
public and stays: it changes only with a line in the changelog and a version in which the old way still works. All
functions take and return values; only those that name a folder read or write files. They are loaded when they are used
first, so that `import geomocap` is quick.

Examples
--------
>>> import geomocap, numpy as np
>>> tracks = np.zeros((500, 60, 3))                  # yours: points, frames, metres; NaN where unseen
>>> motion = geomocap.find_motion(tracks, fps=30)    # doctest: +SKIP
"""

import importlib
import os
import sys
from typing import TYPE_CHECKING, Any

# Threads without work sleep instead of spinning: on a machine that does other things too, spinning makes short kernels
# several times slower. Read when OpenMP is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
# Frames and parts of kernels are mapped over threads already; matrices here are long and thin, and multiplying them in
# two threads takes up to twenty times as long as in one. Sums have one order, too, however many cores there are.
if "OPENBLAS_NUM_THREADS" not in os.environ:
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    if "numpy" in sys.modules:  # it has read the environment already
        from threadpoolctl import threadpool_limits

        threadpool_limits(1, user_api="blas")

from geomocap.kernel_cache import configure_numba
from geomocap.version import __version__

configure_numba()

if TYPE_CHECKING:
    from geomocap.carving.frames import carve
    from geomocap.carving.sequence_outlines import find_outlines
    from geomocap.carving.volume import working_volume
    from geomocap.dense.dense_frame import measure_cloud
    from geomocap.evaluation.run_evaluation import evaluate
    from geomocap.export.run_export import export_run
    from geomocap.files.capture import Capture, open_capture
    from geomocap.files.scans import ScanSettings, open_scans
    from geomocap.model.frame_geometry import Voxels
    from geomocap.model.motion_paths import MotionPaths
    from geomocap.model.outline_points import OutlinePoints
    from geomocap.model.outlines import Outlines
    from geomocap.model.rig import Rig
    from geomocap.motion import Motion, MotionSettings, find_motion
    from geomocap.outline_refinement import fit_to_outlines
    from geomocap.patches.point_tracking import track
    from geomocap.segmentation.m3 import segment_m3
    from geomocap.silhouettes.silhouette_scene import find_silhouettes
    from geomocap.skeleton.m3_skeleton import skeleton_m3
    from geomocap.subject.model_building import build_model
    from geomocap.subject.model_following import follow_model
    from geomocap.subject.subject_model import SubjectModel, read_model

_HOMES = {  # where each public name is defined
    "Capture": "geomocap.files.capture",
    "Motion": "geomocap.motion",
    "MotionPaths": "geomocap.model.motion_paths",
    "MotionSettings": "geomocap.motion",
    "OutlinePoints": "geomocap.model.outline_points",
    "Outlines": "geomocap.model.outlines",
    "Rig": "geomocap.model.rig",
    "ScanSettings": "geomocap.files.scans",
    "SubjectModel": "geomocap.subject.subject_model",
    "Voxels": "geomocap.model.frame_geometry",
    "build_model": "geomocap.subject.model_building",
    "carve": "geomocap.carving.frames",
    "evaluate": "geomocap.evaluation.run_evaluation",
    "export_run": "geomocap.export.run_export",
    "find_motion": "geomocap.motion",
    "find_outlines": "geomocap.carving.sequence_outlines",
    "find_silhouettes": "geomocap.silhouettes.silhouette_scene",
    "fit_to_outlines": "geomocap.outline_refinement",
    "track": "geomocap.patches.point_tracking",
    "follow_model": "geomocap.subject.model_following",
    "measure_cloud": "geomocap.dense.dense_frame",
    "open_capture": "geomocap.files.capture",
    "open_scans": "geomocap.files.scans",
    "read_model": "geomocap.subject.subject_model",
    "segment_m3": "geomocap.segmentation.m3",
    "skeleton_m3": "geomocap.skeleton.m3_skeleton",
    "working_volume": "geomocap.carving.volume",
}
__all__ = [
    "Capture",
    "Motion",
    "MotionPaths",
    "MotionSettings",
    "OutlinePoints",
    "Outlines",
    "Rig",
    "ScanSettings",
    "SubjectModel",
    "Voxels",
    "__version__",
    "build_model",
    "carve",
    "evaluate",
    "export_run",
    "find_motion",
    "find_outlines",
    "find_silhouettes",
    "fit_to_outlines",
    "follow_model",
    "measure_cloud",
    "open_capture",
    "open_scans",
    "read_model",
    "segment_m3",
    "skeleton_m3",
    "track",
    "working_volume",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'geomocap' has no attribute '{name}'")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
