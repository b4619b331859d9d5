"""Cameras that contradict the others, found and named from silhouettes that each camera has decided alone.

What the others deny of each silhouette (`ray_agreement.unexplained`), averaged over frames and cameras, is the
contradiction of a recording. A camera is at fault if that falls to less than half once something is done to it alone:
its images are turned, mirrored, enlarged, inverted, changed for another camera's or for those of another moment. Then
that is what is wrong with it. If no such remedy helps, it is at fault if without it the contradiction falls to less
than half, and more than half of what it sees, or of what the others see, is denied, or a tenth of both: a silhouette
with mistakes is denied where it has too much, or denies where it lacks something; one in the wrong place does both.
A third of what it sees is enough if as much of that stands still: then its background is wrong; and anything on both
sides if it sees nothing in a frame in which the others see the subject: then the subject is in its background.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from geomocap.carving.silhouette_views import PinholeViews, Undistortion
from geomocap.carving.subject_bounds import focus
from geomocap.silhouettes.ray_agreement import unexplained

CLEAR = 0.01  # of the silhouettes: less contradiction than this comes from pixels
STILL = 1 / 3  # of what a camera sees: half as much as the rest
DISPLACED = 0.1  # of silhouettes: what is missed or added by mistake is denied on one side only, not on both
MANY = 4  # cameras from which on one may be set aside to judge the others
LAGS = (1, 3, 9, 27)  # frames by which a camera may be late or early

Moments = Callable[[int, Sequence[int]], list[np.ndarray]]
Turn = tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True)
class Contradiction:
    """Cameras that contradict the others.

    Attributes
    ----------
    cameras : tuple of str
        One; two that are mixed up; or all, if it can't be said which of them.
    what : str
        What is wrong with them, or seems so.
    before, after : float
        Part of the silhouettes that other cameras deny, and what is left of it with a remedy, or without the camera.
    """

    cameras: tuple[str, ...]
    what: str
    before: float
    after: float

    def __str__(self) -> str:
        """Say what is wrong in one line."""
        several = len(self.cameras) > 1
        figures = ""
        if self.after < self.before:
            figures = f" (cameras deny {self.before:.0%} of each other's silhouettes, else {self.after:.1%})"
        return f"camera{'s' * several} {' and '.join(self.cameras)}: {self.what}{figures}"


@dataclass(frozen=True)
class Remedy:
    """Something that would put a camera right.

    Attributes
    ----------
    what : str
        What is wrong with the camera if it does.
    turn : 2×2 numbers or None
        How pixels move about the middle of the image; None: subject and background change places.
    """

    what: str
    turn: Turn | None = None


REMEDIES = (
    Remedy("its images seem mirrored", ((-1, 0), (0, 1))),
    Remedy("its images seem upside down and mirrored", ((1, 0), (0, -1))),
    Remedy("its images, or its pose, seem upside down", ((-1, 0), (0, -1))),
    Remedy("its images, or its pose, seem rolled by 90°", ((0, -1), (1, 0))),
    Remedy("its images, or its pose, seem rolled by 90°", ((0, 1), (-1, 0))),
    Remedy("its focal length seems to be half of the calibrated one", ((2, 0), (0, 2))),
    Remedy("its focal length seems to be twice the calibrated one", ((0.5, 0), (0, 0.5))),
    Remedy("its silhouettes seem inverted"),
)


@dataclass(frozen=True)
class OwnSilhouettes:
    """Silhouettes that each camera has decided alone, in small images.

    Attributes
    ----------
    undistortion : Undistortion
        Of the small images.
    masks : tuple of F tuples of C arrays (H_c, W_c) uint8
    frames : tuple of F int
        Their numbers.
    seen : tuple of C arrays (H_c, W_c) uint8
        Where the images show anything.
    """

    undistortion: Undistortion
    masks: tuple[tuple[np.ndarray, ...], ...]
    frames: tuple[int, ...]
    seen: tuple[np.ndarray, ...]

    @classmethod
    def of(
        cls, undistortion: Undistortion, masks: Sequence[Sequence[np.ndarray]], frames: Sequence[int] | None = None
    ) -> OwnSilhouettes:
        """Gather silhouettes of images that show something everywhere."""
        numbers = range(len(masks)) if frames is None else frames
        rows = tuple(tuple((m > 0).view(np.uint8) for m in row) for row in masks)
        return cls(undistortion, rows, tuple(numbers), tuple(np.ones_like(m) for m in rows[0]))

    def __len__(self) -> int:
        return len(self.seen)

    def views(self) -> list[PinholeViews]:
        """Undistort the silhouettes: one view of all cameras a frame."""
        seen = self.undistortion.views(self.seen).masks
        found = [self.undistortion.views(row) for row in self.masks]
        return [PinholeViews(v.names, v.projections, v.masks & seen, seen) for v in found]

    def denied(self, heeded: np.ndarray, enough: float = np.inf) -> np.ndarray:
        """Part of each silhouette that other cameras deny, (F, C) float; see `unexplained`.

        Frames are not looked at, and count as all denied, once the parts add up to `enough`.
        """
        result = np.ones((len(self.masks), len(heeded)))
        total = 0.0
        for n, views in enumerate(self.views()):
            result[n] = unexplained(views, heeded)
            total += float(np.nansum(result[n]))
            if total > enough:
                break
        return result

    def surrounding(self, camera: int) -> bool:
        """Whether a camera takes most of its image's border for the subject, in most frames: nothing bounds it."""
        shares = [np.concatenate([m[0], m[-1], m[1:-1, 0], m[1:-1, -1]]).mean() for m in self.of_camera(camera)]
        return float(np.median(shares)) > 0.5

    def still(self, camera: int) -> float:
        """Part of what a camera takes for the subject that it does so in all frames."""
        masks = np.array(self.of_camera(camera))
        return float(masks.min(axis=0).sum() * len(masks) / max(int(masks.sum()), 1))

    def gone(self, camera: int) -> list[int]:
        """Frames in which a camera sees nothing, though the middle of what most others see lies in its image."""
        frames = []
        for frame, views in zip(self.frames, self.views(), strict=True):
            blind = views.blind()
            if blind[camera] and blind.sum() < len(blind) / 2:
                x, y, depth = views.projections[camera] @ [*focus(views.without(camera))[0], 1.0]
                u, v = (x / depth, y / depth) if depth > 0 else (-1.0, -1.0)
                height, width = views.valid[camera].shape
                if 0 <= u < width and 0 <= v < height and views.valid[camera][int(v), int(u)]:
                    frames.append(frame)
        return frames

    def of_camera(self, camera: int) -> list[np.ndarray]:
        """Silhouettes of a camera, F arrays (H_c, W_c) uint8."""
        return [row[camera] for row in self.masks]

    def replaced(self, camera: int, masks: Sequence[np.ndarray], seen: np.ndarray | None = None) -> OwnSilhouettes:
        """Return this with other silhouettes of a camera."""
        rows = tuple((*r[:camera], m, *r[camera + 1 :]) for r, m in zip(self.masks, masks, strict=True))
        region = self.seen if seen is None else (*self.seen[:camera], seen, *self.seen[camera + 1 :])
        return replace(self, masks=rows, seen=region)

    def remedied(self, camera: int, turn: Turn | None) -> OwnSilhouettes:
        """Return this with a remedy applied to a camera."""
        own = self.of_camera(camera)
        if turn is None:
            return self.replaced(camera, [np.uint8(1) - m for m in own])
        h, w = own[0].shape
        middle = np.array([w - 1, h - 1]) / 2
        matrix = np.column_stack([np.array(turn), middle - np.array(turn) @ middle])

        def turned(image: np.ndarray) -> np.ndarray:
            return np.asarray(cv2.warpAffine(image, matrix, (w, h), flags=cv2.INTER_NEAREST))

        shrunk = abs(np.linalg.det(turn)) < 1  # what is beyond a smaller image is background
        return self.replaced(camera, [turned(m) for m in own], None if shrunk else turned(self.seen[camera]))

    def swapped(self, a: int, b: int) -> OwnSilhouettes:
        """Return this with the silhouettes of two cameras, whose images have one size, changed for each other."""
        first, second = self.of_camera(a), self.of_camera(b)
        return self.replaced(a, second).replaced(b, first)

    def part(self, rows: Sequence[int]) -> OwnSilhouettes:
        """Return some frames of this."""
        return replace(self, masks=tuple(self.masks[n] for n in rows), frames=tuple(self.frames[n] for n in rows))


@dataclass(frozen=True)
class _Attempt:
    """A remedy, and how much the cameras contradict each other without and with it; `evidence` is put right."""

    cameras: tuple[int, ...]
    what: str
    before: np.ndarray
    after: np.ndarray
    evidence: OwnSilhouettes

    @property
    def helps(self) -> bool:
        """Whether less than half of the contradiction is left, less in most frames, and the cameras see the subject."""
        before, after = mean(self.before), mean(self.after)
        better = [mean(a) < mean(b) for a, b in zip(self.after, self.before, strict=True)]
        own = max(mean(self.after[:, c], nothing=1.0) for c in self.cameras)
        return after < before / 2 and before - after >= CLEAR and sum(better) > len(better) / 2 and own < 0.5


def find_contradictions(
    evidence: OwnSilhouettes, count: int = 0, moments: Moments | None = None
) -> tuple[Contradiction, ...]:
    """Find the cameras that contradict the others, and what is wrong with them.

    Parameters
    ----------
    evidence : OwnSilhouettes
        Of some frames.
    count : int
        Frames of the recording.
    moments : callable, optional
        `moments(camera, frames)`: silhouettes of one camera in other frames, to find one that is late or early.
    """
    found: list[Contradiction] = []
    names, heeded = evidence.undistortion.names, np.ones(len(evidence), bool)
    full = [names[c] for c in range(len(names)) if evidence.surrounding(c)]
    if len(full) > len(names) / 2:
        what = "they take most of their images' borders for the subject; are the silhouettes inverted?"
        return (Contradiction(tuple(full), what, 1.0, 1.0),)
    for c in np.flatnonzero(_empty(evidence)):
        denied = mean(np.array([unexplained(v, blind=np.zeros(len(names), bool)) for v in evidence.views()]))
        heeded[c] = False
        rest = mean(evidence.denied(heeded), nothing=1.0)
        if denied > 0.5 and rest < 0.5:
            found.append(Contradiction((names[c],), "it sees nothing where the others see the subject", denied, rest))
    while len(found) < len(evidence) and (step := _worst(evidence, heeded, count, moments)) is not None:
        wrong, evidence, heeded = step
        found.append(wrong)
    return tuple(found)


def _empty(evidence: OwnSilhouettes) -> np.ndarray:
    """Cameras without silhouette in all frames, (C,) bool; none if that are most of them."""
    empty: np.ndarray = np.asarray(np.array([v.blind() for v in evidence.views()]).all(axis=0))
    return empty & (empty.sum() < len(empty) / 2)


def _worst(
    evidence: OwnSilhouettes, heeded: np.ndarray, count: int, moments: Moments | None
) -> tuple[Contradiction, OwnSilhouettes, np.ndarray] | None:
    """Find the camera that contradicts the others most: what is wrong, and evidence and cameras without that."""
    before = evidence.denied(heeded)
    names, total, n = evidence.undistortion.names, mean(before), int(heeded.sum())
    if total < CLEAR:
        return None
    others = {k: heeded & (np.arange(len(heeded)) != k) for k in np.flatnonzero(heeded).tolist()} if n > 2 else {}
    without = {k: evidence.denied(some) for k, some in others.items()}
    left = {k: mean(d) for k, d in without.items()}
    ranked = sorted(left, key=lambda k: left[k])
    at_fault = [k for k in ranked if left[k] * (n - 1) / n < total / 2]  # no remedy of a camera leaves less than that
    at_fault = [k for k in at_fault if evidence.surrounding(k)] or at_fault
    tried = [a for k in at_fault for a in _attempts(evidence, heeded, k, before) if a.helps]
    if not tried and moments is not None:
        tried = [a for k in at_fault[:1] for a in _lags(evidence, heeded, k, before, count, moments) if a.helps]
    if tried:
        best = min(tried, key=lambda a: mean(a.after) / mean(a.before))
        wrong = tuple(names[c] for c in best.cameras)
        rest = others[best.cameras[0]] if best.evidence is evidence else heeded
        return Contradiction(wrong, best.what, mean(best.before), mean(best.after)), best.evidence, rest
    for k in at_fault[:1]:
        own, theirs = mean(before[:, k]), mean((before - without[k])[:, others[k]])
        still = theirs < STILL < min(own, evidence.still(k))
        gone = [f for f in evidence.gone(k) if min(own, theirs) > CLEAR]
        if max(own, theirs) > 0.5 or min(own, theirs) > DISPLACED or still or gone:
            what = f"the others deny {own:.0%} of what it sees, and it denies {theirs:.0%} of what they see"
            if gone:
                what += f", and in frame {gone[0]} it sees nothing; is the subject in its background?"
            elif still:
                what += ", and much of that stands still; is its background right?"
            if evidence.surrounding(k):
                what = f"it takes {np.mean(evidence.of_camera(k)):.0%} of its image for the subject"
            return Contradiction((names[k],), what, total, left[k]), evidence, others[k]
    if ranked and not at_fault and n > MANY:  # two at fault hide each other
        step = _worst(evidence, others[ranked[0]], count, moments)
        if step is not None:
            return step[0], step[1], step[2] | (heeded & ~others[ranked[0]])
    if total > 0.5:
        every = tuple(name for name, h in zip(names, heeded, strict=True) if h)
        what = "they contradict each other, and no single one is at fault"
        return Contradiction(every, what, total, total), evidence, np.zeros_like(heeded)
    return None


def mean(values: np.ndarray, nothing: float = 0.0) -> float:
    """Mean of what is known; `nothing` if nothing is."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else nothing


def _attempts(evidence: OwnSilhouettes, heeded: np.ndarray, camera: int, before: np.ndarray) -> Iterator[_Attempt]:
    """Try what can be done to a camera's images; what has no outline can only be inverted."""
    full, enough = evidence.surrounding(camera), float(np.nansum(before)) / 2
    for remedy in REMEDIES:
        if not full or remedy.turn is None:
            changed = evidence.remedied(camera, remedy.turn)
            yield _Attempt((camera,), remedy.what, before, changed.denied(heeded, enough), changed)
    for other in np.flatnonzero(heeded).tolist() if not full else ():
        if other != camera and evidence.seen[other].shape == evidence.seen[camera].shape:
            changed, pair = evidence.swapped(camera, other), (min(camera, other), max(camera, other))
            yield _Attempt(pair, "they seem to be mixed up", before, changed.denied(heeded, enough), changed)


def _lags(
    evidence: OwnSilhouettes, heeded: np.ndarray, camera: int, before: np.ndarray, count: int, moments: Moments
) -> list[_Attempt]:
    """Try other moments of a camera: wide apart first, then about the best of them."""
    tried: dict[int, tuple[float, _Attempt]] = {}

    def attempt(lag: int) -> None:
        rows = [n for n, f in enumerate(evidence.frames) if 0 <= f + lag < count]
        if lag in tried or lag == 0 or len(rows) < max(2, len(evidence.frames) / 2) or not mean(before[rows]):
            return
        part = evidence.part(rows)
        changed = part.replaced(camera, moments(camera, [f + lag for f in part.frames]))
        after = changed.denied(heeded, float(np.nansum(before[rows])))
        what = f"it seems to be about {abs(lag)} frame{'s' * (abs(lag) > 1)} {'late' if lag > 0 else 'early'}"
        tried[lag] = mean(after) / mean(before[rows]), _Attempt((camera,), what, before[rows], after, evidence)

    for lag in LAGS:
        attempt(lag)
        attempt(-lag)
    for _ in range(2):
        best = min(tried, key=lambda lag: tried[lag][0], default=0)
        for step in (max(1, abs(best) // 2), max(1, abs(best) // 4)):
            attempt(best - step)
            attempt(best + step)
    return [tried[lag][1] for lag in tried]
