"""The samples of a patch as rows, each with its place in the template."""

from __future__ import annotations

import numpy as np

from geomocap.patches.patch_templates import LANES, fill_samples


def samples_of(curvature, size, radius, most, stride=1):
    """Samples (n, 5) and their places in a template of half the width `most`, (n,)."""
    room = (2 * most + 1) ** 2 + LANES
    samples, index = np.empty((5, room)), np.empty(room, int)
    count = fill_samples(np.asarray(curvature), size, radius, 2 * most + 1, stride, samples, index)
    assert count % LANES == 0
    there = index[:count] >= 0
    assert there[: there.sum()].all() and not samples[:, :count][:, ~there].any()
    return samples[:, :count][:, there].T, index[:count][there]
