"""Figures of quality of a run that need no ground truth, and warnings in words."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import cv2
import numpy as np

from geomocap.model.diagnostics import Diagnostics
from geomocap.model.ellipsoids import Ellipsoids
from geomocap.model.skeleton import Skeleton
from geomocap.scheduling import map_items, threads
from viz import scene
from viz.rendering import Look, Model
from viz.run_contents import Results
from viz.viewpoints import camera_view

MANY_UNASSIGNED = 0.1  # fraction of the points; more without a body are warned of


@dataclass(frozen=True)
class Coverage:
    """How much of the images the silhouettes cover.

    Attributes
    ----------
    cameras : tuple of C str
    frames : (T,) int
    fraction : (C, T) float
        Fraction of the pixels, 0–1, NaN where there is no silhouette.
    cut : (C, T) bool
        Whether the silhouette runs along the image's border: the subject is partly out of view.
    """

    cameras: tuple[str, ...]
    frames: np.ndarray
    fraction: np.ndarray
    cut: np.ndarray


def coverage(results: Results, at_most: int = 80) -> Coverage | None:
    """Measure the silhouettes of at most `at_most` evenly spread frames; None if there are none."""
    cameras = results.silhouette_cameras
    frames = sorted({f for c in cameras for f in results.silhouette_frames(c)})
    if not frames:
        return None
    if len(frames) > at_most:
        frames = [frames[round(p)] for p in np.linspace(0, len(frames) - 1, at_most)]

    def measure(job: tuple[str, int]) -> tuple[float, bool]:
        mask = results.silhouette(*job)
        if mask is None:
            return np.nan, False
        inside = mask > 127
        border = np.concatenate([inside[0], inside[-1], inside[:, 0], inside[:, -1]])
        return float(inside.mean()), bool(border.sum() > 0.004 * len(border) + 2)

    with threads() as executor:
        values = list(map_items(measure, [(c, f) for c in cameras for f in frames], executor))
    shape = (len(cameras), len(frames))
    fraction = np.array([v[0] for v in values]).reshape(shape)
    return Coverage(cameras, np.array(frames), fraction, np.array([v[1] for v in values]).reshape(shape))


def agreement(results: Results, frames: list[int], longest_side: int = 320) -> dict[str, tuple[float, float]]:
    """Compare the volume, seen by each camera, with that camera's silhouettes.

    Returns
    -------
    dict of str to (float, float)
        For each camera: the fraction of the silhouette that the volume covers, and the fraction of the volume's image
        that lies inside the silhouette. A visual hull covers nearly all and sticks out by about half a voxel.
        Empty without a calibrated capture, silhouettes and voxels.
    """
    capture = results.capture
    if capture is None or not capture.is_calibrated or not results.silhouette_cameras:
        return {}
    rig = capture.rig
    cameras = [c for c in results.silhouette_cameras if c in rig.names]

    def measure(frame: int) -> list[tuple[str, float, float]]:
        model = Model([scene.volume(results, frame)])
        found = []
        for camera in cameras:
            mask = results.silhouette(camera, frame)
            if mask is None:
                continue
            view = camera_view(rig, rig.names.index(camera), longest_side)
            seen = model.render(view, Look(samples=1, outline=0, hollows=0)).rgba[..., 3]
            given = cv2.resize(mask, view.size, interpolation=cv2.INTER_AREA) / 255.0
            both = float(np.minimum(seen, given).sum())
            if given.sum() > 0 and seen.sum() > 0:
                found.append((camera, both / float(given.sum()), both / float(seen.sum())))
        return found

    with threads() as executor:
        measured = list(map_items(measure, [f for f in frames if results.has("voxels", f)], executor))
    fractions: dict[str, list[tuple[float, float]]] = {}
    for camera, covered, inside in itertools.chain.from_iterable(measured):
        fractions.setdefault(camera, []).append((covered, inside))
    means = {c: np.mean(v, axis=0) for c, v in fractions.items()}
    return {c: (float(m[0]), float(m[1])) for c, m in means.items()}


@dataclass(frozen=True)
class Bone:
    """A bone between two joints of one body: its name and its length over time, (T,) metres."""

    name: str
    body: int
    lengths: np.ndarray

    @property
    def mean(self) -> float:
        """Mean length, metres."""
        return float(np.nanmean(self.lengths))

    @property
    def spread(self) -> float:
        """Standard deviation of the length over time, metres."""
        return float(np.nanstd(self.lengths))


def bones(skeleton: Skeleton) -> list[Bone]:
    """Return the bones between joints; their lengths should not change over time."""
    result = []
    for body, joint, child in skeleton.bones:
        start = skeleton.body_positions[:, body] if joint < 0 else skeleton.joint_positions[:, joint]
        lengths = np.linalg.norm(skeleton.joint_positions[:, child] - start, axis=1)
        if np.isfinite(lengths).any():
            first = skeleton.body_names[body] if joint < 0 else skeleton.joint_names[joint]
            result.append(Bone(f"{first} – {skeleton.joint_names[child]}", body, lengths))
    return result


def jitter(skeleton: Skeleton) -> np.ndarray:
    """Return the median size of the joints' second differences, (J,) metres; NaN with fewer than three frames.

    A joint that moves evenly has nearly none; one that jumps to and fro has twice its jumps.
    """
    positions = skeleton.joint_positions
    if len(positions) < 3:
        return np.full(positions.shape[1], np.nan)
    second = np.linalg.norm(positions[2:] - 2 * positions[1:-1] + positions[:-2], axis=2)
    return np.array([np.nanmedian(s) if np.isfinite(s).any() else np.nan for s in second.T])


@dataclass(frozen=True)
class PathFigures:
    """Relative paths of ellipsoids and their distances.

    Attributes
    ----------
    relative : (T, K, 3) float, metres
        Paths minus their means over time.
    seed : int
        Ellipsoid nearest to the centre of gravity in the first frame, or the first seed that the run recorded.
    distance : (T, K) float, metres
        Distance curves of all relative paths to the seed's.
    integrals : (K, K) float, metres
        Mean distances over time of all pairs.
    threshold : float or None
        T_sb, if the run recorded it.
    """

    relative: np.ndarray
    seed: int
    distance: np.ndarray
    integrals: np.ndarray
    threshold: float | None


def relative_paths(ellipsoids: Ellipsoids, diagnostics: Diagnostics) -> PathFigures:
    """Return the relative paths and distance curves as the M3 paper defines them (section 7)."""
    centers = ellipsoids.centers
    relative = centers - _mean_over_time(centers)
    there = np.isfinite(centers[0]).all(axis=1)
    middle = np.average(centers[0, there], axis=0, weights=np.maximum(ellipsoids.counts[0, there], 1e-9))
    seeds = diagnostics.seeds
    if seeds is not None and len(seeds):
        seed = int(seeds[0])
    else:
        seed = int(np.nanargmin(np.linalg.norm(centers[0] - middle, axis=1)))
    distance = np.linalg.norm(relative - relative[:, seed : seed + 1], axis=2)
    integrals = diagnostics.integrals
    if integrals is None:
        count = relative.shape[1]
        integrals = np.array(
            [_mean_over_time(np.linalg.norm(relative - relative[:, k : k + 1], axis=2)) for k in range(count)]
        )
    return PathFigures(relative, seed, distance, integrals, diagnostics.threshold)


def _mean_over_time(values: np.ndarray) -> np.ndarray:
    """Mean over the frames (T, ...) that have a value; NaN where none has."""
    number = np.isfinite(values).sum(axis=0)
    return np.where(number > 0, np.nansum(values, axis=0) / np.maximum(number, 1), np.nan)


@dataclass(frozen=True)
class Quality:
    """All figures of quality of a run, as far as its parts are there."""

    coverage: Coverage | None = None
    agreement: dict[str, tuple[float, float]] = field(default_factory=dict)
    bones: list[Bone] = field(default_factory=list)
    jitter: np.ndarray | None = None
    unassigned: float | None = None
    warnings: list[str] = field(default_factory=list)


def assess(results: Results, frames: list[int]) -> Quality:
    """Measure a run; the frames given are those on which costly figures are measured."""
    cover = coverage(results)
    agree = agreement(results, frames[:3])
    skeleton = results.skeleton
    bone_list = bones(skeleton) if skeleton is not None else []
    shaking = jitter(skeleton) if skeleton is not None else None
    unassigned = None
    if "bodies" in results.kinds:
        labels = [results.bodies(f).body for f in frames if results.has("bodies", f)]
        if labels and (len(results.frames) > 1 or any((of_frame >= 0).any() for of_frame in labels)):
            unassigned = float(np.mean(np.concatenate(labels) < 0))  # of one frame bodies are not looked for
    quality = Quality(cover, agree, bone_list, shaking, unassigned)
    return Quality(cover, agree, bone_list, shaking, unassigned, [*results.remarks, *warnings(results, quality)])


def warnings(results: Results, quality: Quality) -> list[str]:
    """Say in words what looks wrong and what it may come from."""
    said: list[str] = []
    if quality.coverage is not None:
        for camera, fraction, cut in zip(
            quality.coverage.cameras, quality.coverage.fraction, quality.coverage.cut, strict=True
        ):
            empty = int((fraction < 1e-4).sum())
            if empty:
                said.append(
                    f"{camera}: the silhouette is empty in {empty} of {len(fraction)} frames looked at; "
                    "this camera has no say there."
                )
            elif np.nanmax(fraction) > 0.5:
                said.append(
                    f"{camera}: a silhouette covers {100 * np.nanmax(fraction):.0f} % of the image; is it background?"
                )
            else:
                typical = float(np.nanmedian(fraction))
                jumps = int((np.abs(fraction - typical) > 0.6 * typical).sum())
                if jumps > 0.2 * len(fraction):
                    said.append(
                        f"{camera}: the silhouette's area is far from its median in {jumps} of {len(fraction)} frames."
                    )
            if cut.any():
                said.append(
                    f"{camera}: the silhouette reaches the image's border in {int(cut.sum())} of {len(cut)} frames; "
                    "what is out of its sight there is left to the other cameras."
                )
    for camera, (covered, inside) in quality.agreement.items():
        if covered < 0.9:
            said.append(
                f"{camera}: the volume covers only {100 * covered:.0f} % of the silhouettes; another camera's "
                "silhouettes miss a part, or the calibration is off."
            )
        elif inside < 0.75:
            said.append(f"{camera}: {100 * (1 - inside):.0f} % of the volume's image lies outside the silhouettes.")
    for kind, counts in results.counts.items():
        if len(counts) > 2 and kind != "bodies":
            change = np.abs(np.diff(counts)) / np.maximum(counts[:-1], 1)
            if (change > 0.4).any():
                at = results.run.frames(kind)[int(np.argmax(change)) + 1]
                said.append(f"{kind}: the number of points jumps by {100 * change.max():.0f} % at frame {at}.")
    ellipsoids, skeleton = results.ellipsoids, results.skeleton
    if ellipsoids is not None and ellipsoids.body_count == 1:
        said.append("Only one body was found: nothing moves against anything else, or the threshold is too high.")
    if quality.unassigned is not None and quality.unassigned > MANY_UNASSIGNED:
        said.append(f"{100 * quality.unassigned:.0f} % of the points belong to no body.")
    varying = [b for b in quality.bones if b.spread > 0.1 * b.mean]
    if varying:
        worst = max(varying, key=lambda b: b.spread / b.mean)
        said.append(
            f"{len(varying)} of {len(quality.bones)} bones change their length by more than 10 % "
            f"(most: {worst.name}, {100 * worst.spread / worst.mean:.0f} %); their joints slide or jump."
        )
    if skeleton is not None and skeleton.joint_count and quality.jitter is not None:
        span = float(np.linalg.norm(np.ptp(skeleton.joint_positions[0], axis=0)))
        restless = [n for n, j in zip(skeleton.joint_names, quality.jitter, strict=True) if j > 0.02 * span]
        if restless:
            listed = ", ".join(restless[:5]) + (" …" if len(restless) > 5 else "")
            said.append(f"{len(restless)} of {len(skeleton.joint_names)} joints jump from frame to frame: {listed}.")
    return said
