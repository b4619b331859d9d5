"""Surface tracking beside OpenCV's pyramidal Lucas–Kanade in every camera with triangulation, on a known motion."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import open3d as o3d

from geomocap.carving.silhouette_views import PinholeViews
from geomocap.patches.frame_views import FrameViews
from geomocap.patches.patch_search import hiding_depth
from geomocap.patches.patch_settings import TrackingSettings
from geomocap.patches.patch_tracking import track_surface
from geomocap.patches.piece_search import free_places, motion_of_piece
from geomocap.patches.seeding import seed_patches, seed_spacing
from geomocap.patches.surface_patches import Patches, visible
from tests.benchmarks.table import Row, measure
from tests.geomocap.moving_ellipsoid import MovingEllipsoid

FRAMES = 8
SCENE = MovingEllipsoid(n_cameras=8, width=640, height=480, focal=900.0, texture=150.0)
SETTINGS = TrackingSettings(n_patches=2000, seed_every=100)
SWUNG = replace(SCENE, turn_deg=(10.0, -25.0, 55.0), shift=(0.12, -0.1, 0.05))


def benchmark() -> list[Row]:
    """Track an ellipsoid that shifts and turns, and find one end of it after a swing."""
    return [_tracking(), _swing()]


def _swing() -> Row:
    """Find a piece of the surface that has turned by 61° and moved by more than half of its length."""
    views = [SWUNG.view(k) for k in range(2)]
    spacing = seed_spacing(views[0], SETTINGS.n_patches)
    seeds = seed_patches(views[0], np.zeros((0, 3)), spacing, SETTINGS, np.random.default_rng(0))
    piece = seeds.select(np.flatnonzero(seeds.positions[:, 2] > 0.12))
    slack = hiding_depth(piece, views[1], SETTINGS.slack_px)

    def ours() -> tuple[np.ndarray, np.ndarray] | None:
        places = free_places(np.zeros((0, 3)), piece, views[1], spacing)
        return motion_of_piece(piece, places, views[1], slack, spacing)

    turn, shift = SWUNG.pose(1)
    true = piece.positions @ turn.T + shift

    def missed(motion: tuple[np.ndarray, np.ndarray] | None) -> str:
        if motion is None:
            return "not found"
        return f"{1000 * np.linalg.norm(piece.positions @ motion[0].T + motion[1] - true, axis=1).mean():.1f} mm off"

    places = free_places(np.zeros((0, 3)), piece, views[1], spacing)

    def theirs() -> tuple[np.ndarray, np.ndarray]:
        found = _global_registration(piece, places, spacing)
        return found[:3, :3], found[:3, 3]

    note = f"ours {missed(ours())}, theirs {missed(theirs())}: the shape alone does not tell how it turned"
    task = f"{len(piece)} patches found after a swing, {len(places)} places, {SWUNG.n_cameras} cameras 640×480"
    return Row(task, measure(ours, 3), "Open3D FPFH + RANSAC", measure(theirs, 3), "1 s", note)


def _global_registration(piece: Patches, places: Patches, spacing: float) -> np.ndarray:
    """Register the piece's points to the places' by the shape around each, (4, 4)."""
    registration = o3d.pipelines.registration
    clouds, features = [], []
    for patches in (piece, places):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(patches.positions))
        cloud.normals = o3d.utility.Vector3dVector(patches.normals)
        around = o3d.geometry.KDTreeSearchParamHybrid(radius=6 * spacing, max_nn=100)
        clouds.append(cloud)
        features.append(registration.compute_fpfh_feature(cloud, around))
    return np.asarray(
        registration.registration_ransac_based_on_feature_matching(
            *clouds,
            *features,
            True,
            1.5 * spacing,
            registration.TransformationEstimationPointToPoint(False),
            3,
            [registration.CorrespondenceCheckerBasedOnDistance(1.5 * spacing)],
            registration.RANSACConvergenceCriteria(100_000, 0.999),
        ).transformation
    )


def _tracking() -> Row:
    frames = [_frame(k) for k in range(FRAMES)]
    track_surface(lambda k: frames[k], 2, SETTINGS)  # compiles
    start = time.perf_counter()
    tracks = track_surface(lambda k: frames[k], FRAMES, SETTINGS)
    total = time.perf_counter() - start
    spacing = seed_spacing(frames[0], SETTINGS.n_patches)
    start = time.perf_counter()
    seeds = seed_patches(frames[0], np.zeros((0, 3)), spacing, SETTINGS, np.random.default_rng(SETTINGS.seed))
    placing = time.perf_counter() - start
    slack = SETTINGS.slack_px * seeds.size[:, None]
    start = time.perf_counter()
    theirs = _lucas_kanade(
        frames, seeds.positions, lambda X, view: visible(X, seeds.frames, seeds.hidden, view, slack, 0.25)
    )
    competitor = time.perf_counter() - start
    seconds = total - placing
    points = int(tracks.measured.sum())
    ours, other = (np.isfinite(p[:, -1, 0]).mean() for p in (tracks.positions, theirs))
    task = f"{len(tracks)} points tracked, {FRAMES} frames, {SCENE.n_cameras} cameras 640×480"
    note = (
        f"{points * SCENE.n_cameras / seconds:,.0f} points × frames × cameras a second; placing the points took "
        f"{placing:.1f} s more; drift median / 95 %: {_drift(tracks.positions)} against {_drift(theirs)} mm; "
        f"followed to the end {ours:.0%} against {other:.0%}"
    )
    goal = "60 frames × 8 cameras × 2,000 points in 60 s"
    return Row(task, seconds, "OpenCV PyrLK + triangulation", competitor, goal, note)


def _frame(k: int) -> FrameViews:
    images, masks = SCENE.images(k)
    noisy = images.astype(float) + np.random.default_rng(k).normal(0, 2, images.shape)
    views = PinholeViews.of(SCENE.projections(), masks)
    return FrameViews.of(views, np.clip(np.rint(noisy), 0, 255).astype(np.uint8), SCENE.voxels(k))


def _lucas_kanade(
    frames: list[FrameViews], positions: np.ndarray, sees: Callable[[np.ndarray, FrameViews], np.ndarray]
) -> np.ndarray:
    """Follow points from frame to frame in each camera that sees them and triangulate: (N, T, 3), NaN when lost."""
    N = len(positions)
    out = np.full((N, len(frames), 3), np.nan)
    out[:, 0] = positions
    P = frames[0].projections
    pixel, _ = frames[0].project(positions)
    seen = sees(positions, frames[0])
    for k in range(1, len(frames)):
        for c in range(len(P)):
            rows = np.flatnonzero(seen[:, c])
            before, after = (np.clip(frames[i].levels[-1, c], 0, 255).astype(np.uint8) for i in (k - 1, k))
            start = pixel[rows, c].astype(np.float32)[:, None]
            found, status, _ = cv2.calcOpticalFlowPyrLK(before, after, start, None, winSize=(11, 11), maxLevel=3)
            pixel[rows, c] = found[:, 0]
            seen[rows[status[:, 0] == 0], c] = False
        lost = seen.sum(axis=1) < 2
        A = P[None, :, :2] - pixel[..., None] * P[None, :, 2:]
        A = (A * seen[:, :, None, None]).reshape(N, -1, 4)
        solution = np.linalg.svd(A)[2][:, -1]
        with np.errstate(invalid="ignore", divide="ignore"):
            out[:, k] = np.where(lost[:, None], np.nan, solution[:, :3] / solution[:, 3:])
    return out


def _drift(positions: np.ndarray) -> str:
    turn, place = SCENE.pose(0)
    body = (positions[:, 0] - place) @ turn
    errors = []
    for k in range(1, FRAMES):
        turn, place = SCENE.pose(k)
        errors.append(np.linalg.norm(positions[:, k] - body @ turn.T - place, axis=1))
    known = np.concatenate(errors)
    known = 1000 * known[np.isfinite(known)]
    return f"{np.median(known):.2f} / {np.percentile(known, 95):.2f}"
