"""The run that compiles the kernels gives the same bits as those that take them from the cache."""

import os
import subprocess
import sys

TRACKING = """
from geomocap.patches.patch_tracking import track_surface
from tests.geomocap.moving_ellipsoid import MovingEllipsoid
from tests.geomocap.test_patches_tracking import SETTINGS
views = [MovingEllipsoid().view(k) for k in range(6)]
found = track_surface(lambda k: views[k], len(views), SETTINGS)
"""
MATCHING = """
from tests.geomocap.image_pairs import match_pairs, pair
from tests.geomocap.test_matching_lsm import AFFINE, CENTER, HEIGHT, SHIFT, SPECKLE, WIDTH, grid, warped
images = SPECKLE.render(HEIGHT, WIDTH), SPECKLE.render(HEIGHT, WIDTH, AFFINE, SHIFT, CENTER)
found = match_pairs(pair(*images), grid(), warped(grid()).round())
"""
PRINT = "import hashlib; print(hashlib.sha256(found.positions.tobytes()).hexdigest())\n"


def test_compiling_changes_no_bit(tmp_path) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", TRACKING + PRINT + MATCHING + PRINT]
    first, second = (
        subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout for _ in range(2)
    )
    assert len(first.split()) == 2 and first == second
