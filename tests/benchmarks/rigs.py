"""Bodies from perfect tracks of many rigs: `python -m tests.benchmarks.rigs NOISE_MM TRUTH [TRUTH …]`.

Each TRUTH is a folder with `truth.npz`. 8,000 points of its surface, evenly spread, with white noise, are given to
`find_motion`, and what it finds is judged: some four seconds each. So a change of how bodies are found is tried on
dozens of subjects in a minute or two, apart from how well they can be followed in images.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from geomocap.evaluation.body_scores import CORE_WEIGHT, adjusted_rand_index
from geomocap.evaluation.skeletons import judge_skeleton
from geomocap.evaluation.truth import Truth
from geomocap.files.scan_geometry import ScanSurface, places_on
from geomocap.motion import find_motion

POINTS = 8000
HEADS = {
    "recall 5 %": "joints.recall_at_5%h",
    "precision": "joints.precision_at_10%h",
    "error %h": "joints.mean_error_%h",
    "edges": "skeleton.true_edges_found",
    "false": "skeleton.false_edges",
    "rotation °": "motion.body_rotation_error_deg",
}


def figures_of(truth: Truth, noise: float) -> dict[str, float]:
    """What is found from tracks with so much noise, metres, against the truth."""
    places = places_on(ScanSurface(truth.vertices[0], truth.faces), POINTS, seed=1)
    tracks = np.stack([places.of(vertices) for vertices in truth.vertices], axis=1)
    of_vertices = truth.body_weights
    if of_vertices is None:
        of_vertices = np.eye(len(truth.bodies))[truth.bodies.of_joint[truth.vertex_joint]]
    weights = places.of(of_vertices)
    rng = np.random.default_rng(1)
    motion = find_motion(tracks + rng.normal(scale=noise, size=tracks.shape), fps=truth.fps)
    true, core = weights.argmax(axis=1), weights.max(axis=1) >= CORE_WEIGHT
    votes = np.zeros((len(truth.bodies), motion.body_count), int)
    known = motion.labels >= 0
    np.add.at(votes, (true[known], motion.labels[known]), 1)
    judged = judge_skeleton(motion.skeleton, truth, votes).figures
    index = adjusted_rand_index(motion.labels[core], true[core])
    counted = {"found / true": motion.body_count / len(truth.bodies), "core": index}
    return counted | {head: float(judged.get(name, np.nan)) for head, name in HEADS.items()}


def main(noise: str, *folders: str) -> None:
    """Print a line for each rig, and the means of all."""
    rows = []
    for folder in folders:
        row = figures_of(Truth.read(Path(folder)), float(noise) / 1000)
        rows.append(list(row.values()))
        print(f"{Path(folder).name:32}", *(f"{head} {value:.2f}" for head, value in row.items()), sep="  ", flush=True)
    print(
        f"{'mean':32}",
        *(f"{head} {mean:.3f}" for head, mean in zip(row, np.nanmean(rows, axis=0), strict=True)),
        sep="  ",
    )


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    main(*sys.argv[1:])
