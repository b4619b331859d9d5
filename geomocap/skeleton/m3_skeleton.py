"""The skeleton of a segmentation by ellipsoids: joints between adjacent bodies, and their motion."""

from __future__ import annotations

from geomocap.model.skeleton import Skeleton, body_names, joint_names
from geomocap.segmentation.axis_joints import grow_joints
from geomocap.segmentation.body_connections import connect_bodies
from geomocap.segmentation.m3_result import Segmentation
from geomocap.segmentation.skeleton_settings import SkeletonSettings
from geomocap.skeleton.bone_motion import fit_motion, fit_offsets, forward_kinematics


def skeleton_m3(segmentation: Segmentation, fps: float, settings: SkeletonSettings | None = None) -> Skeleton:
    """Find the joints between the bodies, and the motion (section 8).

    Bones are turned towards the joints of each frame, unless tracked points tell how they turn.

    Parameters
    ----------
    segmentation : Segmentation
    fps : float
        Frames per second.
    settings : SkeletonSettings, optional

    Raises
    ------
    GeometryError
        If the segmentation has no bodies, as that of a single scan.
    """
    settings = settings or SkeletonSettings()
    bodies = segmentation.bodies
    # Which adjacent bodies are connected
    hierarchy = connect_bodies(segmentation.contacts, segmentation.touching, bodies.centers, settings.min_touching)
    # Joints, frame by frame
    step = settings.sample_step * segmentation.spacing
    found, _ = grow_joints(bodies.centers, bodies.radii, bodies.rotations, hierarchy.joint_bodies, step)
    # Motion
    positions = segmentation.body_positions
    root_positions = positions[:, hierarchy.root]
    observed = (segmentation.body_rotations, root_positions, found, positions)
    if segmentation.carried:
        turned, (offsets, body_offsets) = segmentation.body_rotations, fit_offsets(hierarchy, *observed)
    else:
        turned, offsets, body_offsets = fit_motion(hierarchy, *observed)
    fixed = forward_kinematics(hierarchy, offsets, hierarchy.local_rotations(turned), root_positions)[0]
    names = body_names(bodies.counts.shape[1])
    return Skeleton(
        fixed if settings.fixed_joints else found,
        hierarchy.joint_bodies,
        joint_names(hierarchy.joint_bodies, names),
        names,
        turned,
        positions,
        hierarchy.root,
        offsets,
        body_offsets,
        settings.fixed_joints,
        float(fps),
    )
