"""What a right result of a made-up subject is, and results that are wrong by one body."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import open3d as o3d


@dataclass(frozen=True)
class Gate:
    """Bounds on the figures of `geomocap evaluate`; number of bodies and edges have to be right in any case.

    Attributes
    ----------
    rand_index : float
        Least adjusted Rand index of the bodies' cores.
    joint_error : float
        Largest mean distance of the joints from the true ones, per cent of the height.
    rotation_deg : float
        Largest mean error of the bodies' rotations since the first frame.
    near : int
        Per cent of the height within which every true joint has to have a found one: 5, or 10 where joints are hinges,
        as nothing that moves tells where along its axis a hinge is.
    """

    rand_index: float
    joint_error: float
    rotation_deg: float
    near: int = 5

    def broken(self, figures: Mapping[str, float]) -> list[str]:
        """Name the figures that are wrong, with their values; none if the result is right."""
        right = {
            "bodies.found": lambda found: found == figures["truth.bodies"],
            "bodies.core_adjusted_rand_index": lambda index: index >= self.rand_index,
            f"joints.recall_at_{self.near}%h": lambda recall: recall == 1,
            "joints.precision_at_10%h": lambda precision: precision == 1,
            "joints.mean_error_%h": lambda error: error <= self.joint_error,
            "skeleton.true_edges_found": lambda edges: edges == 1,
            "skeleton.false_edges": lambda edges: edges == 0,
            "motion.body_rotation_error_deg": lambda error: error <= self.rotation_deg,
        }
        return [f"{name} {figures[name]:g}" for name, holds in right.items() if not holds(figures[name])]


def split_body(run: Path, into: Path, body: int) -> Path:
    """Copy a run, with a body cut in two across its longest axis and joined again by a joint."""
    skeleton = _copy(run, into)
    turned, middle = skeleton["body_rotations"], skeleton["body_positions"]
    clouds = sorted((into / "bodies").glob("*.ply"))
    points, label = _labelled(clouds[0])
    points = points[label == body]
    along = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][0]
    for k, file in enumerate(clouds):
        points, label = _labelled(file)
        beyond = (points - middle[k, body]) @ (turned[k, body] @ along) > 0
        _relabel(file, np.where((label == body) & beyond, turned.shape[1], label))
    own = [[body, turned.shape[1]]]
    np.savez(
        into / "skeleton.npz",
        joint_positions=np.concatenate([skeleton["joint_positions"], middle[:, [body]]], axis=1),
        joint_bodies=np.concatenate([skeleton["joint_bodies"], own]),
        joint_names=np.append(skeleton["joint_names"], "joint_cut"),
        body_rotations=np.concatenate([turned, turned[:, [body]]], axis=1),
        body_positions=np.concatenate([middle, middle[:, [body]]], axis=1),
        fps=skeleton["fps"],
    )
    return into


def merge_bodies(run: Path, into: Path, joint: int) -> Path:
    """Copy a run, with the two bodies of a joint made one."""
    skeleton = _copy(run, into)
    kept, gone = skeleton["joint_bodies"][joint]
    number = np.arange(skeleton["body_rotations"].shape[1] + 1)  # the last: of points without a body
    number[gone] = kept
    number = np.where(number > gone, number - 1, number)
    number[-1] = -1
    for file in (into / "bodies").glob("*.ply"):
        _relabel(file, number[_labelled(file)[1]])
    bodies = number[skeleton["joint_bodies"]]
    np.savez(
        into / "skeleton.npz",
        joint_positions=np.delete(skeleton["joint_positions"], joint, axis=1),
        joint_bodies=np.delete(bodies, joint, axis=0),
        joint_names=np.delete(skeleton["joint_names"], joint),
        **{name: np.delete(skeleton[name], gone, axis=1) for name in ("body_rotations", "body_positions")},
        fps=skeleton["fps"],
    )
    return into


def largest_body(run: Path) -> int:
    """Number of the body with most points in the first frame."""
    label = _labelled(run / "bodies/000000.ply")[1]
    return int(np.bincount(label[label >= 0]).argmax())


def _copy(run: Path, into: Path) -> dict[str, np.ndarray]:
    into.mkdir()
    shutil.copytree(run / "bodies", into / "bodies")
    shutil.copy(run / "run.toml", into)
    with np.load(run / "skeleton.npz") as arrays:
        return dict(arrays)


def _labelled(file: Path) -> tuple[np.ndarray, np.ndarray]:
    cloud = o3d.t.io.read_point_cloud(str(file))
    return cloud.point.positions.numpy().astype(float), cloud.point["body"].numpy().ravel()


def _relabel(file: Path, label: np.ndarray) -> None:
    cloud = o3d.t.io.read_point_cloud(str(file))
    cloud.point["body"] = o3d.core.Tensor(label.astype(np.int32)[:, None])
    assert o3d.t.io.write_point_cloud(str(file), cloud)
