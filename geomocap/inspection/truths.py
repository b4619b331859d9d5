"""Truths of synthetic captures, described."""

from __future__ import annotations

from pathlib import Path

from geomocap.errors import GeomocapError
from geomocap.evaluation.truth import Truth
from geomocap.inspection.description import Description, shortened


def describe_truth(path: Path) -> Description:
    """Describe a truth folder or file."""
    told = Description(path, "truth")
    try:
        truth = Truth.read(path)
    except GeomocapError as error:
        told.problem(error)
        return told
    told.fact("motion", f"{truth.n_frames} frames at {truth.fps:g} per second, {truth.n_frames / truth.fps:.2f} s")
    told.fact("mesh", f"{truth.vertices.shape[1]} vertices, {len(truth.faces)} faces, {truth.height:.3f} m high")
    told.fact("rig", f"{len(truth.joint_names)} joints: {shortened([str(n) for n in truth.joint_names])}")
    begin = [str(truth.joint_names[j]) for j in truth.bodies.root]
    told.fact("bodies that move", f"{len(begin)}, beginning at {shortened(begin, 20)}")
    told.fact("skin weights", "given" if truth.vertex_weights is not None else "none")
    if len(truth.bodies) < 2:
        told.problem("nothing in it moves by 15° or more against its parent: there is one body and no joint to find")
    return told
