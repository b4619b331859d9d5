import numpy as np
import open3d as o3d
import pytest
from scipy.spatial import cKDTree

from geomocap.errors import GeometryError
from geomocap.export.export_errors import MotionError
from geomocap.export.export_settings import ExportSettings
from geomocap.export.skeleton_motion import motion_from_skeleton
from geomocap.export.skin import majority, node_of_body, skin_from_run, skin_weights
from geomocap.files.run import Run
from geomocap.model.rotations import rotation_about
from geomocap.model.surface import Surface, outward_normals, point_spacing, surface_through
from tests.geomocap.articulated import skeleton_of

VOXEL = 0.02
RADIUS = 0.1


def arm_shell():
    """Surface voxels of a capsule along x from 0 to 1 m: the shell of a solid, as carving gives it."""
    x, y, z = np.meshgrid(np.arange(-7, 58), np.arange(-7, 7), np.arange(-7, 7), indexing="ij")
    p = (np.stack([x, y, z], -1) + 0.5) * VOXEL
    solid = distance_to_arm(p) < 0
    inner = solid.copy()
    for axis in range(3):
        for shift in (1, -1):
            inner &= np.roll(solid, shift, axis)
    return p[solid & ~inner]


def distance_to_arm(p):
    along = np.clip(p[..., 0], 0, 1)
    return np.linalg.norm(p - np.stack([along, 0 * along, 0 * along], -1), axis=-1) - RADIUS


def bending_arm(n_frames=9):
    """Upper arm still, forearm bending by up to 60° about z at x = 0.5 m."""
    bend = np.deg2rad(60) * np.linspace(0, 1, n_frames)
    R = np.stack([np.tile(np.eye(3), (n_frames, 1, 1)), rotation_about(2, bend)], axis=1)
    elbow = np.array([0.5, 0, 0])
    fore = elbow + np.einsum("tij,j->ti", R[:, 1], [0.25, 0, 0])
    upper = np.tile([0.25, 0, 0], (n_frames, 1))
    return {
        "joint_positions": np.tile(elbow, (n_frames, 1, 1)),
        "joint_bodies": np.array([[0, 1]]),
        "joint_names": np.array(["joint_body00_body01"]),
        "body_rotations": R,
        "body_positions": np.stack([upper, fore], axis=1),
        "fps": np.array(15.0),
    }


@pytest.fixture(scope="module")
def arm_run(tmp_path_factory):
    run = Run(tmp_path_factory.mktemp("arm"))
    points = arm_shell()
    body = (points[:, 0] > 0.5).astype(np.int32)
    body[::50] = -1
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(points.astype(np.float32)))
    cloud.point["body"] = o3d.core.Tensor(body[:, None])
    colors = np.array([[255, 0, 0], [0, 0, 255], [128, 128, 128]], np.uint8)[body]
    cloud.point["colors"] = o3d.core.Tensor(colors)
    (run.path / "bodies").mkdir()
    o3d.t.io.write_point_cloud(str(run.frame_file("bodies", 0)), cloud)
    run.write_npz("skeleton.npz", **bending_arm())
    return run


def test_normals_of_a_shell_look_outwards():
    points = arm_shell()
    normals = outward_normals(points)
    axis = np.stack([np.clip(points[:, 0], 0, 1), 0 * points[:, 0], 0 * points[:, 0]], -1)
    outward = points - axis
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    assert np.sum(normals * outward, axis=1).min() > 0.8


def test_surface_lies_on_the_points():
    surface = surface_through(arm_shell(), max_triangles=5000)
    assert len(surface.triangles) <= 5000
    # Surface voxels' centres lie up to a voxel inside the surface.
    assert np.abs(distance_to_arm(surface.vertices) + VOXEL / 2).max() < VOXEL
    assert cKDTree(surface.vertices).query(arm_shell())[0].max() < 3 * VOXEL
    assert np.linalg.norm(surface.normals, axis=1) == pytest.approx(1)


def test_same_points_same_surface():
    first, second = (surface_through(arm_shell(), max_triangles=2000) for _ in range(2))
    np.testing.assert_array_equal(first.vertices, second.vertices)
    np.testing.assert_array_equal(first.triangles, second.triangles)


def test_skin_follows_the_bending_arm(arm_run):
    motion = motion_from_skeleton(skeleton_of(bending_arm()))
    mesh = skin_from_run(arm_run, motion, ExportSettings(skin_triangles=5000))
    posed = mesh.posed(motion)
    np.testing.assert_allclose(posed[0], mesh.vertices, atol=1e-9)
    # Away from the elbow the last frame is the rigid motion of the two halves.
    fore, upper = mesh.vertices[:, 0] > 0.75, mesh.vertices[:, 0] < 0.25
    np.testing.assert_allclose(posed[-1][upper], mesh.vertices[upper], atol=1e-6)
    elbow, turn = np.array([0.5, 0, 0]), rotation_about(2, np.deg2rad(60))
    np.testing.assert_allclose(posed[-1][fore], (mesh.vertices[fore] - elbow) @ turn.T + elbow, atol=1e-6)
    border = np.abs(mesh.vertices[:, 0] - 0.5) < 0.01
    assert mesh.weights[border].max() < 0.85  # blended, not torn
    assert mesh.weights.sum(axis=1) == pytest.approx(1)
    assert (mesh.colors[upper] == [255, 0, 0]).all()
    assert (mesh.colors[fore] == [0, 0, 255]).all()


def test_another_reference_frame_binds_in_its_pose(arm_run):
    motion = motion_from_skeleton(skeleton_of(bending_arm()))
    straight = motion_from_skeleton(
        skeleton_of({k: v[::-1] if np.ndim(v) > 2 else v for k, v in bending_arm().items()})
    )
    settings = ExportSettings(skin_triangles=5000)
    for m in (motion, straight):
        mesh = skin_from_run(arm_run, m, settings)
        np.testing.assert_allclose(mesh.posed(m)[mesh.bind_frame], mesh.vertices, atol=1e-9)


def test_weights_blend_as_wide_as_asked():
    """On a flat strip the weight across a straight border is the normal distribution's integral."""
    from scipy.stats import norm

    step, blend = 0.01, 0.05
    x, y = np.meshgrid(np.arange(100), np.arange(12), indexing="ij")
    vertices = np.stack([x.ravel() * step, y.ravel() * step, 0 * x.ravel()], -1)
    a = (x[:-1, :-1] * 12 + y[:-1, :-1]).ravel()
    triangles = np.concatenate([np.stack([a, a + 12, a + 13], 1), np.stack([a, a + 13, a + 1], 1)])
    surface = Surface(vertices, np.tile([0.0, 0, 1], (1200, 1)), triangles)
    nodes, weights = skin_weights(surface, (vertices[:, 0] > 0.495).astype(int), 2, blend)
    right = np.where(nodes == 1, weights, 0).sum(axis=1)
    middle = (y.ravel() >= 4) & (y.ravel() <= 7)
    expected = norm.cdf((vertices[:, 0] - 0.495) / blend)
    np.testing.assert_allclose(right[middle], expected[middle], atol=0.07)


def test_single_wrong_labels_are_outvoted(arm_run):
    points = arm_shell()
    labels = (points[:, 0] > 0.5).astype(int)
    wrong = labels.copy()
    wrong[::10] = 2
    away = np.abs(points[:, 0] - 0.5) > 0.05
    np.testing.assert_array_equal(majority(points, wrong, points)[away], labels[away])
    np.testing.assert_array_equal(majority(points[:4], labels[:4], points[:2]), labels[:2])


def test_frames_and_points_that_make_no_skin(arm_run):
    motion = motion_from_skeleton(skeleton_of(bending_arm()))
    with pytest.raises(MotionError, match=r"000005.ply: missing; the skin needs a frame that was segmented"):
        skin_from_run(arm_run, motion, ExportSettings(skin_frame=5))
    with pytest.raises(MotionError, match="no colours there"):
        skin_from_run(arm_run, motion, ExportSettings(skin_colors="true"))
    with pytest.raises(GeometryError, match="3 points are too few"):
        surface_through(np.eye(3))
    with pytest.raises(GeometryError, match="all points coincide"):
        point_spacing(np.zeros((60, 3)))
    with pytest.raises(MotionError, match="body07 has points but no place"):
        node_of_body(motion, np.array([0, 1, 7]))


def test_a_surface_is_the_finest_with_few_enough_triangles():
    points = np.random.default_rng(2).normal(size=(20_000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    coarse, middle, fine = (len(surface_through(points, points, most).triangles) for most in (20_000, 60_000, 10**6))
    assert coarse <= 20_000 < middle <= 60_000 < fine
    assert len(surface_through(points, points, middle).triangles) == middle
    assert len(surface_through(points, points, middle - 1).triangles) == coarse
    assert len(surface_through(points, points, fine // 2).triangles) == middle
