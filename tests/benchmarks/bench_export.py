"""Motion files: writing and reading 1,000 frames of 20 bodies, and skinning a surface."""

from __future__ import annotations

import contextlib
import importlib
import io
import tempfile
from pathlib import Path

from geomocap.export.bvh import read_bvh, write_bvh
from geomocap.export.glb import write_glb
from geomocap.export.markers import markers_from_run
from geomocap.export.skeleton_motion import motion_from_skeleton
from geomocap.export.trc import write_trc
from tests.benchmarks.table import Row, measure
from tests.geomocap.articulated import skeleton_arrays

FRAMES, BODIES = 1000, 20


def benchmark() -> list[Row]:
    """Time each format; reading BVH beside the reader of bvhsdk where it is installed."""
    arrays = skeleton_arrays(n_bodies=BODIES, n_frames=FRAMES)
    motion = motion_from_skeleton(arrays)
    markers = markers_from_run(arrays)
    size = f"{FRAMES} frames, {BODIES} bodies"
    with tempfile.TemporaryDirectory() as folder:
        bvh, glb, trc = (Path(folder) / f"motion.{ending}" for ending in ("bvh", "glb", "trc"))
        rows = [
            Row(f"skeleton to motion, {size}", measure(lambda: motion_from_skeleton(arrays), 3)),
            Row(f"write BVH, {size}", measure(lambda: write_bvh(bvh, motion), 3)),
            Row(f"write TRC, {size}", measure(lambda: write_trc(trc, markers), 3)),
            Row(f"write GLB with bones, {size}", measure(lambda: write_glb(glb, motion), 3)),
        ]
        ours = measure(lambda: read_bvh(bvh).forward_kinematics(), 3)
        rows.append(_beside_bvhsdk(f"read BVH and place all joints, {size}", ours, bvh))
    return rows


def _beside_bvhsdk(task: str, ours: float, file: Path) -> Row:
    try:
        bvhsdk = importlib.import_module("bvhsdk")
    except ImportError:
        return Row(task, ours, note="bvhsdk isn't installed")

    def theirs() -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            animation = bvhsdk.ReadFile(str(file))
            for joint in animation.getlistofjoints():
                for frame in range(0, FRAMES, 100):
                    joint.getPosition(frame)

    return Row(task, ours, "bvhsdk (every 100th frame)", measure(theirs, 1, warm_up=False))
