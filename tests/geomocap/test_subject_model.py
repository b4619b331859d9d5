import numpy as np
import pygltflib
import pytest

from geomocap.bodies.body_settings import MotionBodiesSettings
from geomocap.bodies.motion_bodies import find_motion_bodies
from geomocap.errors import GeometryError
from geomocap.export.run_export import export_run
from geomocap.files.results import write_skeleton
from geomocap.files.run import Run
from geomocap.model.motion_paths import MotionPaths
from geomocap.skeleton.kinematics import JointMotion, body_motion
from geomocap.skeleton.motion_skeleton import find_motion_skeleton
from geomocap.subject.model_building import BodyCloud, build_model, key_poses
from geomocap.subject.subject_model import SubjectModel, read_model, rotation_limits, write_model
from tests.geomocap.moving_chains import chain

SPACING = 0.012


def box_shell(low, high):
    """Points on the surface of a box, a grid of them."""
    axes = [np.arange(a, b + 1e-9, SPACING) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    last = np.array([a[-1] for a in axes])
    return grid[((grid == np.array(low)) | (grid == last)).any(axis=1)]


@pytest.fixture(scope="module")
def sequence():
    """Chain of two boxes, its bodies and skeleton, and the geometry of its frames."""
    scene = chain(2, samples=120)
    bodies = find_motion_bodies(MotionPaths(scene.positions), MotionBodiesSettings(bodies=2))
    found = find_motion_skeleton(bodies, 30.0)
    shell = box_shell([0.0, -0.06, -0.05], [0.8, 0.06, 0.05])
    rest_label = bodies.label[
        [np.linalg.norm(bodies.rest - p, axis=1).argmin() for p in shell]
    ]  # along x the nearest sample is of the right box

    def read(frame):
        moved = np.einsum("nij,nj->ni", bodies.rotations[frame][rest_label], shell)
        colors = np.tile([1.0, 0.5, 0.0], (len(shell), 1))
        return BodyCloud(moved + bodies.translations[frame][rest_label], rest_label, colors)

    return bodies, found, shell, read


@pytest.fixture(scope="module")
def model(sequence):
    bodies, found, _, read = sequence
    return build_model(found, bodies, read, SPACING)


def test_surface_is_the_boxes(model, sequence):
    _, _, shell, _ = sequence
    distance = np.linalg.norm(model.points[:, None] - shell[None, ::7], axis=2).min(axis=1)
    assert distance.max() < 3 * SPACING
    inside = (model.points[:, 0] > 0.1) & (model.points[:, 0] < 0.3)
    outward = model.points[inside] - np.array([0.2, 0.0, 0.0]) * [1, 0, 0]
    outward[:, 0] = 0.0
    assert (np.einsum("ni,ni->n", model.normals[inside], outward) > 0).all()
    np.testing.assert_array_equal(model.colors[0], [255, 128, 0])


def test_a_point_that_one_frame_invents_is_left_out(sequence):
    bodies, found, _, read = sequence

    def with_ghost(frame):
        cloud = read(frame)
        if frame != 0:
            return cloud
        ghost = np.full((1, 3), 0.5)
        return BodyCloud(
            np.concatenate([cloud.points, ghost]), np.append(cloud.body, 0), np.concatenate([cloud.colors, ghost])
        )

    model = build_model(found, bodies, with_ghost, SPACING)
    assert np.linalg.norm(model.points - 0.5, axis=1).min() > 0.2


def test_limits_and_poses_are_those_seen(model):
    size = np.abs(model.joint_limits).max()
    assert np.deg2rad(45) < size < np.deg2rad(55)
    assert 2 <= len(model.poses) <= 8
    np.testing.assert_allclose(model.poses[0], np.tile(np.eye(3), (2, 1, 1)), atol=1e-12)


def test_key_poses_are_far_apart():
    angle = np.linspace(0, 1, 30)
    local = np.zeros((30, 1, 3, 3))
    local[:, 0, 0, 0] = angle  # any numbers do
    assert key_poses(local, 3).tolist()[:2] == [0, 29]
    assert key_poses(local, 3)[2] in (14, 15)


def test_model_file_comes_back_as_it_was(model, tmp_path):
    write_model(tmp_path / "model.npz", model)
    again = read_model(tmp_path / "model.npz")
    for name in SubjectModel.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(again, name), getattr(model, name))
    assert read_model(str(tmp_path / "model.npz")).body_names.tolist() == model.body_names.tolist()


def test_a_model_moves_in_another_world_as_it_does_in_its_own(model):
    """Turned so that y points up it takes the same poses, turned, within the same limits."""
    turned = model.turned_up(1)
    assert turned.up == 1 and turned.turned_up(2).up == 2
    np.testing.assert_array_equal(turned.points[:, 1], model.points[:, 2])
    np.testing.assert_array_equal(turned.turned_up(2).points, model.points)
    change = np.roll(np.eye(3), -1, axis=0)
    assert np.linalg.det(change) > 0
    before, after = (
        body_motion(m.linkage, JointMotion(m.poses, np.tile(m.origin, (len(m.poses), 1)))) for m in (model, turned)
    )
    for one, other in zip(*(b.carry(*m) for b, m in ((before, skin(model)), (after, skin(turned)))), strict=True):
        np.testing.assert_allclose(other, one @ change.T, atol=1e-9)
    limits = rotation_limits(turned.poses[:, turned.joint_bodies[:, 1]])
    assert (turned.joint_limits[:, 0] <= limits[:, 0] + 1e-9).all()
    assert (turned.joint_limits[:, 1] >= limits[:, 1] - 1e-9).all()


def skin(model):
    return model.points, model.skin_bodies, model.skin_weights


def broken(arrays, how):
    if how == "shape":
        return {**arrays, "joints": arrays["joints"][:, :2]}
    if how == "missing":
        return {k: v for k, v in arrays.items() if k != "poses"}
    if how == "tree":
        return {**arrays, "joint_bodies": np.array([[1, 1]])}
    if how == "numbers":
        return {**arrays, "points": np.full_like(arrays["points"], np.nan)}
    if how == "version":
        return {**arrays, "version": np.array(99)}
    return {"points": arrays["points"]}


@pytest.mark.parametrize("how", ["shape", "missing", "tree", "numbers", "version", "other"])
def test_bad_model_gives_one_clear_line(model, tmp_path, how):
    write_model(tmp_path / "model.npz", model)
    Run(tmp_path).write_npz("model.npz", **broken(Run(tmp_path).read_npz("model.npz"), how))
    with pytest.raises(GeometryError) as error:
        read_model(tmp_path / "model.npz")
    assert "model.npz" in str(error.value) and "\n" not in str(error.value)


def test_damaged_and_missing_files_give_one_clear_line(tmp_path):
    (tmp_path / "model.npz").write_bytes(b"PK\x03\x04 nothing")
    for name in ("model.npz", "none.npz"):
        with pytest.raises(GeometryError) as error:
            read_model(tmp_path / name)
        assert name in str(error.value) and "\n" not in str(error.value)


def test_glb_shows_the_models_skin_with_its_weights(model, sequence, tmp_path):
    _, found, _, _ = sequence
    run = Run(tmp_path)
    write_model(tmp_path / "model.npz", model)
    write_skeleton(run, found.skeleton)
    export_run(run, ["glb"])
    file = pygltflib.GLTF2().load(tmp_path / "motion.glb")
    assert len(file.skins[0].joints) == 2
    accessor = file.accessors[file.meshes[0].primitives[0].attributes.POSITION]
    assert accessor.count > 500  # bones would have 24 corners each
    np.testing.assert_allclose(accessor.max[0], 0.8, atol=0.03)
    view = file.bufferViews[file.accessors[file.meshes[0].primitives[0].attributes.WEIGHTS_0].bufferView]
    data = file.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
    weights = np.frombuffer(data, "<f4").reshape(-1, 4)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-6)
    assert ((weights[:, 0] < 0.95) & (weights[:, 0] > 0.3)).any()
