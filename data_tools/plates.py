"""Background plates from recordings in which the subject never leaves its place."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from geomocap.errors import CaptureError
from geomocap.silhouettes.background import BackgroundModel, background_over_time
from geomocap.silhouettes.light import light_change
from geomocap.silhouettes.silhouette_settings import SilhouetteSettings

MATCHING_SIZE = 1000  # longer side of the pictures that key-points are matched on, pixels
LEAST_MATCHES = 12
STEADY = 0.6  # fraction of the frames from which the video's own colour may be the background
ALWAYS = 0.97  # fraction of the frames from which the video is believed more than the picture
CONFIRMED = 0.06  # fraction of the frames that must show the reference's colour to confirm it
ENCLOSED = 0.3  # a steady region with less of its surroundings steady lies inside the subject
MARGIN = 3  # pixels around a difference that count with it


def compose_plate(frames: Iterable[np.ndarray], reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compose the empty scene from a video and a picture of the same view with the subject elsewhere.

    The picture is registered to the video (size, offset, turn, exposure). At each pixel the background is what video
    and picture agree on, in some frames at least; where they never do, it is the video where it hardly changes, and
    the picture where the video keeps changing and the picture isn't taken by the subject itself: its regions there go
    to background or subject with the region that they blend into (watershed of the picture's gradient).

    Parameters
    ----------
    frames : iterable of (H, W, 3) uint8
        Frames spread over the video, RGB; 15 to 40 are enough.
    reference : (H', W', 3) uint8
        The picture; other size, crop and exposure are allowed.

    Returns
    -------
    plate : (H, W, 3) uint8
        The empty scene, as the video sees it.
    known : (H, W) bool
        False where neither shows the background.

    Raises
    ------
    CaptureError
        If there are fewer than three frames or the picture doesn't show the same view.
    """
    frames = list(frames)
    mean, sigma, support = background_over_time(frames, SilhouetteSettings())
    model = BackgroundModel(mean, sigma, support > 0)
    affine = register(reference, model.mean.clip(0, 255).astype(np.uint8))
    moved, inside = warp(reference, affine, model.size)
    moved = match_exposure(moved, inside, model)

    tolerance = _tolerance(moved, model, inside)
    agreed = _confirmed(frames, model, moved, tolerance) & inside
    steady = np.asarray(cv2.medianBlur((support >= STEADY).astype(np.uint8), 5)) > 0

    # Video where it hardly changes; a part that doesn't fit its surroundings is the subject standing still
    from_video = (steady | ~inside) & ~agreed
    from_video &= ~_standing_still(from_video & inside, agreed, steady, model.mean, moved)

    # Picture elsewhere, but for the subject in it
    taken = _taken_by_subject(moved, agreed, from_video & inside)
    from_picture = inside & ~agreed & ~from_video & ~taken

    known = agreed | from_video | from_picture
    same = agreed & ((np.abs(model.mean - moved).max(axis=-1) < tolerance) | (support >= ALWAYS))
    plate = np.where((from_video | same)[..., None], model.mean, moved)
    return np.clip(np.rint(plate), 0, 255).astype(np.uint8), known


def register(picture: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Find the similarity that takes array indices of a picture to those of another of the same view.

    Parameters
    ----------
    picture, target : (H', W', 3), (H, W, 3) uint8

    Returns
    -------
    (2, 3) float

    Raises
    ------
    CaptureError
        If too few key-points (SIFT, ratio test, RANSAC) agree on one.
    """
    points, descriptors = [], []
    sift = cv2.SIFT.create(4000)
    for image in (picture, target):
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        scale = min(1.0, MATCHING_SIZE / max(gray.shape))
        small = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else gray
        ratio = np.array(small.shape[::-1]) / np.array(gray.shape[::-1])
        found, description = sift.detectAndCompute(small, None)
        xy = np.array([k.pt for k in found]).reshape(-1, 2)
        points.append((xy + 0.5) / ratio - 0.5)
        descriptors.append(description)
    used = 0
    if all(d is not None and len(d) >= 2 for d in descriptors):
        matches = cv2.BFMatcher().knnMatch(descriptors[0], descriptors[1], k=2)
        good = [a for a, b in matches if a.distance < 0.75 * b.distance]
        if len(good) >= LEAST_MATCHES:
            source = points[0][[m.queryIdx for m in good]]
            goal = points[1][[m.trainIdx for m in good]]
            reach = 2.0 * max(1.0, max(target.shape) / MATCHING_SIZE)
            affine, inliers = cv2.estimateAffinePartial2D(source, goal, ransacReprojThreshold=reach, refineIters=50)
            used = 0 if affine is None else int(inliers.sum())
    if used < LEAST_MATCHES:
        raise CaptureError(
            f"reference picture: only {used} points agree with the video, expected at least {LEAST_MATCHES}; "
            "give a picture taken by the same camera from the same place"
        )
    return affine


def warp(picture: np.ndarray, affine: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Resample a picture by an affine map of array indices; return it, (H, W, 3) uint8, and where it reaches."""
    moved = cv2.warpAffine(picture, affine, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    ones = np.full(picture.shape[:2], 255, np.uint8)
    return moved, cv2.warpAffine(ones, affine, size, flags=cv2.INTER_LINEAR) == 255


def match_exposure(picture: np.ndarray, inside: np.ndarray, model: BackgroundModel) -> np.ndarray:
    """Bring a registered picture to the video's exposure: gain and offset a channel, (H, W, 3) float32."""
    gain, offset = light_change(picture, model.mean, model.sigma, model.known & inside)
    return ((picture - offset) / gain).clip(0, 255).astype(np.float32)


def _tolerance(picture: np.ndarray, model: BackgroundModel, inside: np.ndarray) -> np.ndarray:
    """Difference up to which video and picture show the same, grey levels, (H, W) float32.

    The noise model of the video, times how much larger the difference to the picture is on the whole (sharpness and
    compression differ).
    """
    ratio = np.abs(picture - model.mean).max(axis=-1)[inside] / model.sigma[inside]
    return 4.0 * np.minimum(max(1.0, float(np.median(ratio))) * model.sigma, 6.0)


def _confirmed(
    frames: list[np.ndarray], model: BackgroundModel, picture: np.ndarray, tolerance: np.ndarray
) -> np.ndarray:
    """Where enough frames agree with the picture, (H, W) bool."""
    count = np.zeros(tolerance.shape, np.float32)
    for frame in frames:
        gain, offset = light_change(frame, model.mean, model.sigma, model.known)
        corrected = ((frame - offset) / gain).astype(np.float32)
        count += np.abs(corrected - picture).max(axis=-1) < tolerance
    enough = (count >= max(2.0, CONFIRMED * len(frames))).astype(np.uint8)
    return np.asarray(cv2.morphologyEx(enough, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))) > 0


def _standing_still(
    candidates: np.ndarray, agreed: np.ndarray, steady: np.ndarray, video: np.ndarray, picture: np.ndarray
) -> np.ndarray:
    """Regions of the video that fit the agreed background around them worse than the picture's does.

    Each connected region is compared along its border: colour steps from the agreed pixels just outside to the region
    in the video and in the picture. A region whose surroundings mostly change lies inside the subject.
    """
    result = np.zeros_like(candidates)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(candidates.astype(np.uint8), connectivity=8)
    for k in range(1, count):
        x, y, w, h, _ = stats[k]
        rows = slice(max(0, y - MARGIN), y + h + MARGIN)
        cols = slice(max(0, x - MARGIN), x + w + MARGIN)
        region = labels[rows, cols] == k
        known = agreed[rows, cols]
        ring = cv2.dilate(region.astype(np.uint8), np.ones((2 * MARGIN + 1, 2 * MARGIN + 1), np.uint8)) > 0
        ring &= ~region
        if np.count_nonzero(steady[rows, cols][ring]) < ENCLOSED * np.count_nonzero(ring):
            result[rows, cols] |= region
            continue
        steps = []
        for axis, shift in ((0, 1), (0, -1), (1, 1), (1, -1)):
            beside = np.roll(known, shift * MARGIN, axis=axis) & region
            if beside.any():
                outside = np.roll(video[rows, cols], shift * MARGIN, axis=axis)[beside]
                steps.append([np.abs(source[rows, cols][beside] - outside).sum(-1) for source in (video, picture)])
        if steps:
            in_video, in_picture = (np.concatenate([s[i] for s in steps]) for i in range(2))
            if np.median(in_video) > 1.5 * np.median(in_picture) + 6.0:
                result[rows, cols] |= region
    return result


def _taken_by_subject(picture: np.ndarray, agreed: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """Where the picture shows the subject: what blends into parts that differ from the steady video.

    Parameters
    ----------
    picture : (H, W, 3) float32
    agreed : (H, W) bool
        Background for certain.
    covered : (H, W) bool
        Differs from the video where that is steady: subject in the picture for certain.

    Returns
    -------
    (H, W) bool
    """
    kernel = np.ones((2 * MARGIN + 1, 2 * MARGIN + 1), np.uint8)
    certain = cv2.erode(covered.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    markers = np.zeros(covered.shape, np.int32)
    markers[agreed] = 1
    markers[certain] = 2
    smooth = cv2.GaussianBlur(picture.clip(0, 255).astype(np.uint8), (0, 0), 1.0)
    cv2.watershed(cv2.cvtColor(smooth, cv2.COLOR_RGB2BGR), markers)
    taken = (markers != 1) & ~agreed
    return cv2.dilate(taken.astype(np.uint8), kernel) > 0
