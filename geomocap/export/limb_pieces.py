"""Pieces of a limb that a person's skeleton doesn't have, taken out of the chain of its bones.

Where a thigh was found in two bodies, retargeting tools copy the turn of the bone that is called the thigh against its
parent, and what the other piece turns is lost. Hung beside the chain it changes nothing of the motion, and each named
bone turns against the named one before it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geomocap.export.motion_tree import MotionTree
from geomocap.naming.found_names import FoundNames

STILL = 1e-5  # m: a bone whose origin moves no more in its parent isn't moving


def pieces_beside(motion: MotionTree, found: FoundNames) -> MotionTree:
    """Return the same motion in which no bone of a named part hangs on one without.

    Parameters
    ----------
    motion : MotionTree
        In its rest pose.
    found : FoundNames
    """
    named = np.isin(motion.bodies, list(found.whole))
    named[0] = True
    parents = motion.parents.copy()
    for n in range(1, motion.n_nodes):
        while named[n] and not named[parents[n]]:
            parents[n] = parents[parents[n]]
    R, p = motion.forward_kinematics()
    _, rest = motion.bind_pose(None)
    rotations, translations = motion.rotations.copy(), motion.translations.copy()
    offsets, moving, tips = motion.offsets.copy(), motion.moving.copy(), motion.tips.copy()
    for n in np.flatnonzero(parents != motion.parents).tolist():
        before, piece = parents[n], motion.parents[n]
        back = R[:, before].swapaxes(1, 2)
        rotations[:, n] = back @ R[:, n]
        translations[:, n] = np.einsum("tij,tj->ti", back, p[:, n] - p[:, before])
        offsets[n] = rest[n] - rest[before]
        moving[n] = np.linalg.norm(translations[:, n] - offsets[n], axis=1).max() > STILL
        if not (parents == piece).any():
            tips[piece] = motion.offsets[n]
    return replace(
        motion,
        parents=parents,
        rotations=rotations,
        translations=translations,
        offsets=offsets,
        moving=moving,
        tips=tips,
    )
