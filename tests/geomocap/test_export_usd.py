import numpy as np
import pytest

from geomocap.export.skeleton_motion import motion_from_skeleton
from geomocap.export.skinned_mesh import bone_mesh
from geomocap.export.usd import write_usd
from tests.geomocap.articulated import skeleton_arrays, skeleton_of

pytest.importorskip("pxr")


def z_up(points):
    return points[..., [0, 2, 1]] * [1, -1, 1]


@pytest.mark.parametrize("kind", [{}, {"jump_mm": 15.0}])
@pytest.mark.parametrize("ending", ["usda", "usdc"])
def test_joints_and_surface_read_back_by_usdskel(tmp_path, kind, ending):
    from pxr import Usd, UsdGeom, UsdSkel, Vt

    arrays = skeleton_arrays(**kind)
    motion = motion_from_skeleton(skeleton_of(arrays))
    mesh = bone_mesh(motion)
    write_usd(tmp_path / f"m.{ending}", motion, mesh)
    stage = Usd.Stage.Open(str(tmp_path / f"m.{ending}"))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert stage.GetTimeCodesPerSecond() == 15
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, 19)

    cache = UsdSkel.Cache()
    root = UsdSkel.Root(stage.GetDefaultPrim())
    cache.Populate(root, Usd.PrimDefaultPredicate)
    skeleton = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/subject/skeleton")))
    surface = stage.GetPrimAtPath("/subject/surface")
    skinning = cache.GetSkinningQuery(surface)
    posed = mesh.posed(motion)
    names = [str(j).split("/")[-1] for j in skeleton.GetJointOrder()]
    assert names == list(motion.names)
    for frame in range(20):
        found = z_up(np.array(skeleton.ComputeJointSkelTransforms(frame))[:, 3, :3])
        for node, joint in enumerate(motion.joints):
            if joint >= 0:
                np.testing.assert_allclose(found[node], arrays["joint_positions"][frame, joint], atol=1e-5)
        points = Vt.Vec3fArray(UsdGeom.Mesh(surface).GetPointsAttr().Get())
        assert skinning.ComputeSkinnedPoints(skeleton.ComputeSkinningTransforms(frame), points, frame)
        np.testing.assert_allclose(z_up(np.array(points)), posed[frame], atol=1e-5)
