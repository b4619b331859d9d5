from __future__ import annotations

import numpy as np
import pytest
import trimesh

from data_tools.figure import figure, mechanism
from data_tools.solids import box, capsule, cylinder, ellipsoid


@pytest.mark.parametrize(
    ("solid", "volume", "tolerance"),
    [
        (box((0, 0, 0), (1, 2, 3)), 6.0, 1e-9),
        (cylinder(0.5, 1.0, 0), np.pi * 0.25 * 2, 0.02),
        (ellipsoid((0.2, 0.3, 0.4), (1, 1, 1)), 4 / 3 * np.pi * 0.024, 0.06),
        (capsule(1.0, (0.1, 0.1)), np.pi * 0.01 + 4 / 3 * np.pi * 0.001, 0.05),
    ],
)
def test_solids_are_closed_and_face_outwards(solid, volume: float, tolerance: float) -> None:
    mesh = trimesh.Trimesh(solid.vertices, solid.faces)  # merges seams
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(volume, rel=tolerance)  # polygons lie inside round shapes


def turns(asset, samples: int = 61) -> dict[str, np.ndarray]:
    """Greatest turn of each joint against its parent between any two times, degrees, and the rotations."""
    rotations = np.array([asset.joint_transforms(t)[1] for t in np.linspace(0, asset.duration, samples)])
    found = {}
    for joint, parent in enumerate(asset.joint_parents):
        if parent >= 0:
            found[asset.joint_names[joint]] = rotations[:, parent].transpose(0, 2, 1) @ rotations[:, joint]
    return found


def greatest_angle(relative: np.ndarray) -> float:
    trace = np.einsum("aij,bij->ab", relative, relative)
    return float(np.rad2deg(np.arccos(np.clip((trace - 1) / 2, -1, 1))).max())


def test_every_joint_of_the_figure_turns() -> None:
    asset = figure()
    angles = {name: greatest_angle(relative) for name, relative in turns(asset).items()}
    assert len(angles) == 15
    assert min(angles.values()) > 25, angles
    assert np.ptp(asset.vertices(0)[:, 2]) == pytest.approx(1.75)


def test_figure_repeats_without_a_jump_and_stays_above_the_floor() -> None:
    asset = figure()
    np.testing.assert_allclose(asset.vertices(asset.duration), asset.vertices(0.0), atol=1e-9)
    assert min(asset.vertices(t)[:, 2].min() for t in np.linspace(0, asset.duration, 60)) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("asset", [figure(), mechanism()], ids=lambda a: a.name)
def test_parts_are_rigid_and_bones_keep_their_length(asset) -> None:
    owner = asset.vertex_weights.argmax(axis=1)

    def in_joints(time: float) -> np.ndarray:
        positions, rotations = asset.joint_transforms(time)
        return np.einsum("vji,vj->vi", rotations[owner], asset.vertices(time) - positions[owner])

    np.testing.assert_allclose(in_joints(0.3), in_joints(1.1), atol=1e-9)
    child = np.flatnonzero(asset.joint_parents >= 0)
    lengths = [
        np.linalg.norm(p[child] - p[asset.joint_parents[child]], axis=1)
        for p in (asset.joint_transforms(0.3)[0], asset.joint_transforms(1.1)[0])
    ]
    np.testing.assert_allclose(lengths[0], lengths[1], atol=1e-9)


def test_neighbouring_parts_touch() -> None:
    asset = figure()
    vertices, owner = asset.vertices(0.4), asset.vertex_weights.argmax(axis=1)
    for joint, parent in enumerate(asset.joint_parents):
        if parent >= 0:
            own, other = vertices[owner == joint], vertices[owner == parent]
            gap = np.linalg.norm(own[:, None] - other[None], axis=2).min()
            assert gap < 0.03, (asset.joint_names[joint], gap)


def test_hinges_turn_about_their_stated_axes() -> None:
    asset = mechanism()
    relative = turns(asset)
    axes = asset.truth_extras["hinge_axes"]
    for joint, axis in zip(asset.truth_extras["hinge_joints"], axes, strict=True):
        motion = relative[asset.joint_names[joint]]
        np.testing.assert_allclose(motion @ axis, np.tile(axis, (len(motion), 1)), atol=1e-9)
        assert greatest_angle(motion) > 25
    assert len(axes) == len(asset.joint_names) - 1  # all but the stand
