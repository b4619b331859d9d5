"""How bodies and skeleton came about, for reports and for those who look closer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Diagnostics:
    """What a segmentation says of its own making; None where its method has no such thing.

    Attributes
    ----------
    paths : str, optional
        What the bodies were found from: "patches", "nodes", "both", "pieces", "points", "ellipsoids", or "model".
    sample_positions : (N, T, 3) float, metres, world
        Motion paths that the bodies were found from.
    sample_body : (N,) int
        Body of each, -1: none.
    sample_residuals : (N,) or (N, T) float
    body_confidence : (B,) float
        0 to 1: 1/2 where a body just pays for its freedoms, 2/3 where it pays twice.
    reliability : (T, B) float
        How well each body was measured in each frame.
    joint_costs : (J,) float, metres
    joint_is_hinge : (J,) bool
    joint_axes : (J, 3) float
    joint_std : (J, 3) float, metres
    curve_bodies, curve_strengths : (S,) int, float
        Steps of the elimination of bodies.
    alternative_labels : (A, N) int
        Bodies of the samples with other numbers of bodies.
    fit_distance : (T,) float, metres
        Distance of a followed model from the sequence.
    first_frame : int
        Frame in which the model was found.
    integrals : (K, K) float, metres
        Mean distance of relative paths of ellipsoids.
    threshold : float, metres
        Up to which ellipsoids belong to one body.
    seeds : (B,) int
        Ellipsoid from which each body was found.
    repaired : (T,) int
        Ellipsoids split in matching.
    touching : (B, B) float
        Fraction of the frames in which two bodies touch.
    body : (K,) int
        Body of each ellipsoid.
    """

    paths: str | None = None
    sample_positions: np.ndarray | None = None
    sample_body: np.ndarray | None = None
    sample_residuals: np.ndarray | None = None
    body_confidence: np.ndarray | None = None
    reliability: np.ndarray | None = None
    joint_costs: np.ndarray | None = None
    joint_is_hinge: np.ndarray | None = None
    joint_axes: np.ndarray | None = None
    joint_std: np.ndarray | None = None
    curve_bodies: np.ndarray | None = None
    curve_strengths: np.ndarray | None = None
    alternative_labels: np.ndarray | None = None
    fit_distance: np.ndarray | None = None
    first_frame: int | None = None
    integrals: np.ndarray | None = None
    threshold: float | None = None
    seeds: np.ndarray | None = None
    repaired: np.ndarray | None = None
    touching: np.ndarray | None = None
    body: np.ndarray | None = None
