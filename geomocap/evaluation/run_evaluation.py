"""A run against the truth, whatever form the truth has."""

from __future__ import annotations

from pathlib import Path

from geomocap.evaluation.body_scores import judge_bodies
from geomocap.evaluation.evaluation_settings import EvaluationSettings
from geomocap.evaluation.other_system import compare_markers, read_matches, read_motion_file
from geomocap.evaluation.result import Evaluation, EvaluationError
from geomocap.evaluation.skeletons import judge_skeleton
from geomocap.evaluation.surfaces import judge_surface
from geomocap.evaluation.track_scores import judge_tracks
from geomocap.evaluation.truth import Truth
from geomocap.export.conventions import Axis, Unit
from geomocap.export.run_export import run_markers, run_up
from geomocap.files.results import SKELETON, TRACKS, read_skeleton, read_trajectories
from geomocap.files.run import Run
from geomocap.progress import Progress, silent

RATE_TOLERANCE = 0.01


def evaluate(
    run: str | Path,
    truth: str | Path,
    settings: EvaluationSettings | None = None,
    *,
    matches: str | Path | None = None,
    unit: Unit = "m",
    up: Axis | None = None,
    progress: Progress = silent,
) -> Evaluation:
    """Compare a run with the truth.

    Parameters
    ----------
    run : str or Path
        Run folder; what it has files for is judged.
    truth : str or Path
        A synthetic capture's truth (folder with truth.npz), or a C3D, TRC or BVH file of another system.
    settings : EvaluationSettings, optional
    matches : str or Path, optional
        TOML that says which marker is which joint: `joint_body01_body03 = "LKNE"`. Another system only.
    unit : "m", "cm" or "mm"
        Unit of a BVH, which can't say it itself.
    up : "x", "y" or "z", optional
        Axis of the motion file that points up, where it isn't the format's custom.
    progress : Progress

    Raises
    ------
    EvaluationError
        If the truth can't be used or doesn't belong to the run, or the run holds nothing to judge.
    MotionError
        If a motion file can't be read.
    """
    settings = settings or EvaluationSettings()
    run, truth = Path(run), Path(truth)
    if not run.is_dir():
        raise EvaluationError(f"{run}: no such run folder")
    if truth.is_dir() or truth.suffix.lower() == ".npz":
        if matches is not None:
            raise EvaluationError(f"{matches}: matches name another system's markers; {truth} is a synthetic truth")
        return evaluate_synthetic(Run(run), Truth.read(truth), settings, progress=progress)
    opened = Run(run)
    found = run_markers(opened, read_skeleton(opened), None, run_up(opened), ellipsoids=False)
    other = read_motion_file(truth, unit=unit, up=up)
    return compare_markers(found, other, settings, matches=read_matches(Path(matches)) if matches else None)


def evaluate_synthetic(
    run: Run, truth: Truth, settings: EvaluationSettings | None = None, *, progress: Progress = silent
) -> Evaluation:
    """Compare a run with the truth of its synthetic capture: surface, bodies, skeleton, tracks.

    Raises
    ------
    EvaluationError
        If the frame rates differ, or the run holds nothing to judge.
    """
    settings = settings or EvaluationSettings()
    frames = range(0, truth.n_frames, settings.every)
    parts = [judge_surface(run, truth, "voxels", frames)]
    progress("evaluate", 1, 5)
    parts.append(judge_surface(run, truth, "cloud", frames))
    progress("evaluate", 2, 5)
    bodies, votes = judge_bodies(run, truth, frames)
    parts.append(bodies)
    progress("evaluate", 3, 5)
    if run.has(SKELETON):
        skeleton = read_skeleton(run)
        _check_rate(run, skeleton.fps, truth)
        parts.append(judge_skeleton(skeleton, truth, votes))
    progress("evaluate", 4, 5)
    if run.has(TRACKS):
        parts.append(judge_tracks(read_trajectories(run).positions, truth))
    progress("evaluate", 5, 5)
    figures: dict[str, float] = {"truth.bodies": len(truth.bodies), "truth.height_m": round(truth.height, 3)}
    for part in parts:
        figures |= part.figures
    if len(figures) == 2:
        raise EvaluationError(f"{run.path}: holds no voxels, cloud, bodies, skeleton or tracks to judge")
    curves = tuple(c for part in parts for c in part.curves)
    return Evaluation(figures, curves, tuple(m for part in parts for m in part.matches))


def _check_rate(run: Run, fps: float, truth: Truth) -> None:
    if abs(fps / truth.fps - 1) > RATE_TOLERANCE:
        raise EvaluationError(
            f"{run.path}: its skeleton has {fps:g} frames per second, the truth {truth.fps:g}; "
            "they belong to different captures, or one rate is wrong"
        )
