"""USD (UsdSkel): the skeleton animated, with a surface that it moves.

Axes y up, metres, both stated by the stage. One time code is one frame. Needs the package `usd-core`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from geomocap.export.conventions import USD
from geomocap.export.export_errors import require
from geomocap.export.glb import linear_light
from geomocap.export.motion_tree import MotionTree
from geomocap.export.skinned_mesh import INFLUENCES, SkinnedMesh, bone_mesh
from geomocap.files.atomic import by_library, write_atomic
from geomocap.model.rotations import quaternions

ROOT, SKELETON, ANIMATION, SURFACE = "/subject", "/subject/skeleton", "/subject/skeleton/motion", "/subject/surface"


def write_usd(path: Path, motion: MotionTree, mesh: SkinnedMesh | None = None) -> None:
    """Write a motion as USD, whole or not at all; `.usda` is text, `.usdc` and `.usd` are binary.

    Parameters
    ----------
    path : Path
    motion : MotionTree
        In world axes, metres.
    mesh : SkinnedMesh, optional
        The surface that it moves; without one, a bone for each node.

    Raises
    ------
    MissingPackageError
        If usd-core isn't installed.
    """
    require("pxr.Usd", extra="usd", purpose="USD files")
    write_atomic(path, by_library(lambda p: _write(p, motion, mesh or bone_mesh(motion))))


def _write(path: Path, motion: MotionTree, mesh: SkinnedMesh) -> None:
    from pxr import Usd, UsdGeom, UsdSkel

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(motion.fps)
    stage.SetFramesPerSecond(motion.fps)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(motion.n_frames - 1)
    root = UsdSkel.Root.Define(stage, ROOT)
    stage.SetDefaultPrim(root.GetPrim())
    y_up = motion.converted(USD)
    joints = _joint_paths(motion)
    _add_skeleton(stage, y_up, joints, mesh.bind_frame)
    _add_animation(stage, y_up, joints)
    _add_surface(stage, mesh, motion)
    stage.GetRootLayer().Save()


def _joint_paths(motion: MotionTree) -> list[str]:
    """Names as UsdSkel wants them: parent/child/grandchild, each a valid identifier."""
    from pxr import Tf

    paths: list[str] = []
    for name, parent in zip(motion.names, motion.parents.tolist(), strict=True):
        own = Tf.MakeValidIdentifier(name)
        paths.append(own if parent < 0 else f"{paths[parent]}/{own}")
    return paths


def _matrices(rotations: np.ndarray, positions: np.ndarray) -> Any:
    """Transforms as USD holds them, for row vectors."""
    from pxr import Vt

    matrices = np.zeros((len(rotations), 4, 4))
    matrices[:, :3, :3] = rotations.swapaxes(-1, -2)
    matrices[:, 3, :3] = positions
    matrices[:, 3, 3] = 1
    return Vt.Matrix4dArray.FromNumpy(matrices)


def _add_skeleton(stage: Any, motion: MotionTree, joints: list[str], bind_frame: int | None) -> None:
    from pxr import UsdSkel

    R, p = motion.bind_pose(bind_frame)
    skeleton = UsdSkel.Skeleton.Define(stage, SKELETON)
    skeleton.CreateJointsAttr(joints)
    skeleton.CreateBindTransformsAttr(_matrices(R, p))
    skeleton.CreateRestTransformsAttr(_matrices(motion.rotations[0], motion.translations[0]))
    binding = UsdSkel.BindingAPI.Apply(skeleton.GetPrim())
    binding.CreateAnimationSourceRel().SetTargets([ANIMATION])


def _add_animation(stage: Any, motion: MotionTree, joints: list[str]) -> None:
    from pxr import Gf, UsdSkel, Vt

    animation = UsdSkel.Animation.Define(stage, ANIMATION)
    animation.CreateJointsAttr(joints)
    animation.CreateScalesAttr(Vt.Vec3hArray(motion.n_nodes, Gf.Vec3h(1, 1, 1)))
    translations, rotations = animation.CreateTranslationsAttr(), animation.CreateRotationsAttr()
    q = quaternions(motion.rotations)
    for t in range(motion.n_frames):
        translations.Set(Vt.Vec3fArray.FromNumpy(motion.translations[t].astype(np.float32)), t)
        rotations.Set(Vt.QuatfArray([Gf.Quatf(w, x, y, z) for x, y, z, w in q[t].tolist()]), t)


def _add_surface(stage: Any, mesh: SkinnedMesh, motion: MotionTree) -> None:
    from pxr import Gf, UsdGeom, UsdSkel, Vt

    surface = UsdGeom.Mesh.Define(stage, SURFACE)
    points = USD.points(mesh.vertices, motion.up).astype(np.float32)
    surface.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    surface.CreateExtentAttr([Gf.Vec3f(*points.min(axis=0).tolist()), Gf.Vec3f(*points.max(axis=0).tolist())])
    surface.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.triangles), 3, np.int32)))
    surface.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.triangles.astype(np.int32).ravel()))
    surface.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(USD.points(mesh.normals, motion.up).astype(np.float32)))
    surface.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    surface.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    surface.CreateDoubleSidedAttr(True)
    color = surface.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
    color.Set(Vt.Vec3fArray.FromNumpy(linear_light(mesh.colors / 255.0).astype(np.float32)))
    binding = UsdSkel.BindingAPI.Apply(surface.GetPrim())
    binding.CreateSkeletonRel().SetTargets([SKELETON])
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1.0))
    nodes = binding.CreateJointIndicesPrimvar(constant=False, elementSize=INFLUENCES)
    nodes.Set(Vt.IntArray.FromNumpy(mesh.nodes.astype(np.int32).ravel()))
    weights = binding.CreateJointWeightsPrimvar(constant=False, elementSize=INFLUENCES)
    weights.Set(Vt.FloatArray.FromNumpy(mesh.weights.astype(np.float32).ravel()))
