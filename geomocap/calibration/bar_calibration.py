"""Calibrating cameras with a reference bar, from observations or from a recording on disk, to a COLMAP model."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from geomocap.calibration.bundle_adjustment import AdjustedNetwork
from geomocap.calibration.calibration_quality import (
    CameraMotion,
    CameraPrecision,
    HeldOut,
    ImageCoverage,
    camera_precision,
    coverage,
    held_out,
    image_motion_faults,
    motion,
)
from geomocap.calibration.calibration_settings import BarSettings
from geomocap.calibration.covariance import Covariance, covariance
from geomocap.calibration.datum import Datum, interiors_of
from geomocap.calibration.estimation import Estimate, estimate
from geomocap.calibration.initial import start, two_candidates
from geomocap.calibration.lens_model import Significance, choose_model, prior_for
from geomocap.calibration.stability import Moved, moved_of
from geomocap.calibration.target_observations import TargetObservations
from geomocap.calibration.verdict import Verdict, judge
from geomocap.calibration.world import WorldKnowledge
from geomocap.errors import CalibrationError
from geomocap.files.rigs import colmap_model, write_model
from geomocap.model.colmap_library import pycolmap
from geomocap.model.rig import Rig
from geomocap.progress import Progress, silent

MARK = "calibration.json"
"""File beside a model that says that it is ours and may be replaced."""


@dataclass(frozen=True)
class Calibration:
    """Calibrated cameras, how precise they are and how they were found.

    Attributes
    ----------
    rig : Rig
    adjusted : AdjustedNetwork
        The final adjustment, in the world's frame; `adjusted.network.bars` are the bar ends.
    covariance : Covariance
        In the datum of inner constraints over the bar ends.
    estimate : Estimate
        Labels, outliers and views.
    observations : TargetObservations
    datum : Datum
    tests : tuple of Significance
        Parameters beyond the model (shear among them), with their standard deviations.
    precision : tuple of CameraPrecision
    coverage : tuple of ImageCoverage
    motion : CameraMotion
    held_out : HeldOut
    moved : tuple of Moved
    verdict : Verdict
    up : {"x", "y", "z"}
        Axis of the world that points up.
    """

    rig: Rig
    adjusted: AdjustedNetwork
    covariance: Covariance
    estimate: Estimate
    observations: TargetObservations
    datum: Datum
    tests: tuple[Significance, ...]
    precision: tuple[CameraPrecision, ...]
    coverage: tuple[ImageCoverage, ...]
    motion: CameraMotion
    held_out: HeldOut
    moved: tuple[Moved, ...]
    verdict: Verdict
    up: str

    @property
    def sigma0(self) -> float:
        """A-posteriori standard deviation of unit weight, for the targets' a-priori standard deviations."""
        return self.adjusted.sigma0 * self.estimate.sigma_factor

    def reconstruction(self) -> pycolmap.Reconstruction:
        """Return a COLMAP model: one image `<camera>/000000.png` a camera, the bar ends as points with tracks."""
        model = colmap_model(self.rig)
        n = self.adjusted.network
        residual = np.linalg.norm(self.adjusted.residuals, axis=1)
        last = {int(c): v for v, c in enumerate(n.view_camera)}
        used = np.array([last[int(n.view_camera[v])] == v for v in n.view], dtype=bool)
        position = np.zeros(len(n.bar), dtype=np.int64)
        for c in range(len(n.names)):
            rows = np.flatnonzero(used & (n.view_camera[n.view] == c))
            position[rows] = np.arange(len(rows))
            image = model.images[c + 1]
            image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in n.pixels[rows]])
        point = 2 * n.bar + n.end
        for p, xyz in enumerate(n.bars.reshape(-1, 3)):
            rows = np.flatnonzero(used & (point == p))
            track = pycolmap.Track()
            for m in rows:
                track.add_element(int(n.view_camera[n.view[m]]) + 1, int(position[m]))
            if len(rows) >= 2:
                color = np.array([255, 160, 0] if p % 2 else [0, 160, 255], dtype=np.uint8)
                identifier = model.add_point3D(xyz, track, color)
                model.points3D[identifier].error = float(residual[rows].mean())
        return model

    def record(self) -> dict:
        """Return the figures of the calibration as plain values, for a file beside the model."""
        return {
            "made_by": "geomocap calibrate",
            "grade": self.verdict.grade,
            "summary": self.verdict.summary,
            "warnings": list(self.verdict.warnings),
            "world": self.datum.source,
            "sigma0": round(self.sigma0, 4),
            "bars": len(self.adjusted.network.bars),
            "rays": len(self.adjusted.network.bar),
            "length_m": self.adjusted.network.length,
            "held_out_rms_m": self.held_out.rms,
            "diagonal_m": self.held_out.diagonal,
            "point_sigma_m": self.covariance.point_sigma,
            "cameras": {
                p.camera: {
                    "rays": p.rays,
                    "rms_px": p.rms_px,
                    "center_sigma_m": p.center_sigma,
                    "angle_sigma_deg": p.angle_sigma_deg,
                    "parameters": {k: {"value": v, "sigma": s} for k, (v, s) in p.parameters.items()},
                }
                for p in self.precision
            },
            "tests": [
                {
                    "camera": t.camera,
                    "parameter": t.parameter,
                    "value": t.value,
                    "sigma": t.sigma,
                    "significant": t.significant,
                }
                for t in self.tests
            ],
        }

    def write(self, sparse: Path, *, force: bool = False) -> None:
        """Write the COLMAP model into the folder `sparse`, whole or not at all.

        Raises
        ------
        CalibrationError
            If there is a calibration that was not made by this function, and `force` is not set.
        RunError
            If the folder can't be written.
        """
        sparse = Path(sparse)
        check_replaceable(sparse, force)
        write_model(sparse, self.reconstruction(), beside={MARK: json.dumps(self.record(), indent=1)})


def check_replaceable(sparse: Path, force: bool) -> None:
    """Refuse to replace a calibration that was made by something else.

    Raises
    ------
    CalibrationError
    """
    if sparse.exists() and not force and any(sparse.iterdir()) and not (sparse / MARK).is_file():
        raise CalibrationError(
            f"{sparse}: holds a calibration that was not made by `geomocap calibrate`; use --force to replace it"
        )


def calibrate_bar(
    observations: TargetObservations,
    length: float,
    settings: BarSettings | None = None,
    world: WorldKnowledge | None = None,
    given: Rig | None = None,
    length_sigma: float | None = None,
    target_radius: float | None = None,
    progress: Progress = silent,
) -> Calibration:
    """Calibrate cameras from observations of a bar.

    Parameters
    ----------
    observations : TargetObservations
        From `recording.measure` or `observations.read_observations`.
    length : float
        Distance of the bar's ends, metres.
    settings : BarSettings, optional
    world : WorldKnowledge, optional
        What fixes the world's frame; if nothing does, a warning of the result says what was done instead.
    given : Rig, optional
        Known interior orientations (poses are not used), kept as they are.
    length_sigma : float, optional
        Standard deviation of the length, metres; from the settings if not given.
    target_radius : float, optional
        Radius of the balls, metres; measured if not given.
    progress : callable

    Raises
    ------
    CalibrationError
        If no calibration can be had; the message says why, and what to record.
    """
    settings = settings or BarSettings()
    world = world or WorldKnowledge()
    interior = None if given is None else interiors_of(given.select(observations.cameras))
    steps = 5
    progress("calibrate", 0, steps)
    try:
        begin = start(observations, length, settings, interior)
        progress("calibrate", 1, steps)
        prior, free = prior_for(observations.sizes, begin, interior, settings)
        found = estimate(observations, begin, length, settings, prior, free, length_sigma, target_radius)
        progress("calibrate", 2, steps)
    except CalibrationError as error:
        faults = image_motion_faults(two_candidates(observations), observations.sizes, observations.cameras)
        if not faults:
            raise
        raise CalibrationError(f"{error} ({'; '.join(faults)})") from None
    adjusted, tests = choose_model(found.adjusted, prior, settings)
    progress("calibrate", 3, steps)
    datum = world.datum(adjusted, found.target_radius)
    datum = replace(datum, warnings=datum.warnings + world.doubts(observations.frames))
    adjusted = replace(adjusted, network=datum.apply(adjusted.network))
    cov = covariance(adjusted)
    lengths = held_out(adjusted, settings.folds)
    progress("calibrate", 4, steps)
    precision = camera_precision(adjusted, cov.cameras)
    covered, how = coverage(adjusted.network), motion(adjusted.network)
    moved = moved_of(adjusted.network, found.view_of, observations.frames)
    fitting = (found.chosen >= 0).any(axis=2)
    checkable = (observations.counts >= 2) & (fitting.sum(axis=0) - fitting >= 2)
    lost = (checkable & ~fitting).sum(axis=1) / np.maximum(checkable.sum(axis=1), 1)
    out = found.rejected.sum(axis=(1, 2)) / np.maximum((found.chosen >= 0).sum(axis=(1, 2)), 1)
    verdict = judge(
        adjusted, precision, covered, moved, how, lengths, datum, lost, out, adjusted.sigma0 * found.sigma_factor
    )
    progress("calibrate", steps, steps)
    return Calibration(
        adjusted.network.rig(),
        adjusted,
        cov,
        found,
        observations,
        datum,
        tests,
        precision,
        covered,
        how,
        lengths,
        moved,
        verdict,
        world.up,
    )
