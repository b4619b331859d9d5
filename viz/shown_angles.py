"""Joint angles of a run as pages tell them: the same as in `angles.csv`, with the names that they follow from."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from geomocap.angles.angle_set import AngleSet
from geomocap.errors import GeomocapError
from geomocap.export.angle_files import run_angles
from geomocap.export.run_export import run_settings, run_up
from geomocap.export.run_names import run_names
from viz.run_contents import Results

_OWN = re.compile(r".*_(turn|off_axis)$")
_WORDS = {"turn": "turn about its axis", "off_axis": "about other axes"}


def angles_of(results: Results) -> tuple[AngleSet, str] | None:
    """Return the angles of a run's joints, and a sentence about the names; None if they can't be had."""
    skeleton = results.skeleton
    if skeleton is None:
        return None
    try:
        settings = run_settings(results.run)
        names, found = run_names(results.run, skeleton, run_up(results.run), settings)
        angles = run_angles(results.run, skeleton, names, found, settings)
    except GeomocapError:
        return None  # settings or names that can't be used are told where motion files are written
    if found.template is None:
        return angles, "Named after no template, so bodies keep their numbers and joints turn about their own axes."
    sides = "left and right are told" if found.sides_known else "left and right can't be told, so sides are a and b"
    doubtful = ", ".join(n for b, n in found.bodies.items() if found.confidence[b] < 0.9)
    less = f" Less sure: {doubtful}." if doubtful else ""
    apart = ", ".join(f"{joint} ({body})" for joint, body in found.unparted.items())
    less += f" No angle, because both parts are in one body: {apart}." if apart else ""
    count = f"{len(found.bodies)} of {skeleton.body_count} bodies"
    return angles, f"Named as {found.template.name}, {count}; {sides}.{less}"


def angle_words(name: str) -> str:
    """Return what an angle is called beside the joint that it belongs to."""
    own = _OWN.match(name)
    return _WORDS[own[1]] if own else name.replace("_", " ")


def angles_of_node(angles: AngleSet, parent: int, child: int) -> list[dict[str, Any]]:
    """Return the angles between a body and its parent over time for a page: words, degrees, standard deviations."""

    def told(values: np.ndarray) -> list[float | None]:
        return [round(v, 2) if np.isfinite(v) else None for v in values.tolist()]

    return [
        {
            "name": angle_words(angles.names[k]),
            "values": told(angles.values[:, k]),
            "std": told(angles.std[:, k]) if np.isfinite(angles.std[:, k]).any() else None,
        }
        for k in angles.of_joint(parent, child)
    ]
