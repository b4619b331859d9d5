"""Pieces that moved too far between two frames: how they are told, and found again."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from geomocap.patches.patch_search import hiding_depth
from geomocap.patches.patch_settings import TrackingSettings
from geomocap.patches.patch_tracking import track_surface
from geomocap.patches.piece_search import free_places, motion_of_piece
from geomocap.patches.seeding import seed_patches, seed_spacing
from geomocap.patches.surface_patches import PatchAlignment
from geomocap.patches.swings import LostPiece, find_pieces, lost_pieces
from tests.geomocap.moving_ellipsoid import MovingEllipsoid

# 29 cm and 62 degrees from one frame to the next: nothing is where it was, and other cameras see it
SCENE = MovingEllipsoid(n_cameras=8, turn_deg=(10.0, -25.0, 55.0), shift=(0.18, -0.2, 0.1), distance=1.6, focal=420.0)
SETTINGS = TrackingSettings(n_patches=300, radius_px=4)


@pytest.fixture(scope="module")
def views():
    return [SCENE.view(k) for k in range(2)]


@pytest.fixture(scope="module")
def spacing(views):
    return seed_spacing(views[0], 300)


@pytest.fixture(scope="module")
def seeds(views, spacing):
    return seed_patches(views[0], np.zeros((0, 3)), spacing, SETTINGS, np.random.default_rng(3))


@pytest.fixture(scope="module")
def piece(seeds):
    """Patches of one end, from all around."""
    return seeds.select(np.flatnonzero(seeds.positions[:, 2] > 0.05))


def test_a_piece_is_found_wherever_it_went(views, spacing, piece):
    assert len(piece) > 30
    places = free_places(np.zeros((0, 3)), piece, views[1], spacing)
    slack = hiding_depth(piece, views[1], SETTINGS.slack_px)
    turn, shift = motion_of_piece(piece, places, views[1], slack, spacing)
    true_turn, true_shift = SCENE.pose(1)
    away = piece.positions @ turn.T + shift - (piece.positions @ true_turn.T + true_shift)
    assert np.linalg.norm(away, axis=1).max() < 0.004  # a pixel is 4 mm
    assert np.degrees(Rotation.from_matrix(turn @ true_turn.T).magnitude()) < 1


def test_tracks_go_on_after_a_jump():
    moments = (0.0, 0.02, 1.0, 1.02)  # between the second and the third frame, all move by a body length
    settings = SETTINGS.model_copy(update={"seed_every": 10, "backward": False})
    tracks = track_surface(lambda k: SCENE.view(moments[k]), 4, settings)
    across = tracks.measured[:, 1] & tracks.measured[:, 2]
    assert across.sum() > 40
    (R, t), (S, u) = SCENE.pose(moments[0]), SCENE.pose(moments[2])
    start, end = tracks.positions[across, 0], tracks.positions[across, 2]
    away = np.linalg.norm((start - t) @ R @ S.T + u - end, axis=1)
    assert np.median(away) < 0.002 and np.percentile(away, 90) < 0.006


def test_what_is_not_there_is_not_found(views, spacing, piece):
    slack = hiding_depth(piece, views[1], SETTINGS.slack_px)
    other = replace(SCENE, texture=80.0).view(1)
    places = free_places(np.zeros((0, 3)), piece, other, spacing)
    assert motion_of_piece(piece, places, other, slack, spacing) is None
    # nor where the surface has patches already
    everywhere = free_places(views[1].surface, piece, views[1], spacing)
    assert not len(everywhere)
    assert motion_of_piece(piece, everywhere, views[1], slack, spacing) is None


def test_free_places_keep_away_from_patches(views, spacing, seeds):
    taken = SCENE.pose(1)[0] @ np.array([0.1, 0, 0.2]) + SCENE.pose(1)[1]
    near = views[1].surface[np.linalg.norm(views[1].surface - taken, axis=1) < 0.1]
    places = free_places(near, seeds, views[1], spacing)
    away = np.linalg.norm(places.positions[:, None] - near, axis=2).min(axis=1)
    assert len(places) and away.min() > spacing and (places.has.sum(axis=1) == 1).all()


def _found(patches, frame):
    """Where patches are if they moved with the scene from frame 0."""
    turn, shift = SCENE.pose(frame)
    N, C = patches.has.shape
    zeros = np.zeros(N)
    X, Q = patches.positions @ turn.T + shift, turn @ patches.frames
    return PatchAlignment(X, Q, zeros, zeros.astype(int), zeros, zeros, np.zeros((N, C)))


def test_a_piece_outside_the_silhouettes_is_looked_for_and_placed(views, spacing, seeds):
    identity = np.arange(len(seeds))[::-1].copy() + 7
    top = seeds.positions[:, 2] > 0.05
    (piece,) = lost_pieces(seeds, identity, np.ones(len(seeds), bool), ~top, spacing)
    assert sorted(piece.identity) == sorted(identity[top])
    true = _found(seeds, 1)
    # what is beside it stayed where it was, as far as is known, and carried it along
    known = true.at(np.where(top[:, None], seeds.positions, true.positions), true.frames)
    slack = hiding_depth(seeds, views[1], SETTINGS.slack_px)
    found, placed, left = find_pieces((piece,), seeds, identity, ~top, known, views[1], slack, spacing)
    assert (placed == top).all() and [p.looks for p in left] == [1]
    assert np.linalg.norm(found.positions - true.positions, axis=1).max() < 0.004
    # patches that are found need not be looked for
    _, placed, left = find_pieces(left, seeds, identity, np.ones(len(seeds), bool), true, views[1], slack, spacing)
    assert not placed.any() and left == ()


def test_a_piece_that_is_where_it_was_carried_is_not_looked_for(views, spacing, seeds):
    identity = np.arange(len(seeds))
    top = seeds.positions[:, 2] > 0.05
    pieces = lost_pieces(seeds, identity, np.ones(len(seeds), bool), ~top, spacing)
    slack = hiding_depth(seeds, views[1], SETTINGS.slack_px)
    true = _found(seeds, 1)
    found, placed, left = find_pieces(pieces, seeds, identity, ~top, true, views[1], slack, spacing)
    assert not placed.any() and left == ()
    assert_allclose(found.positions, true.positions)


def test_pieces_are_what_was_lost_side_by_side(seeds, spacing):
    identity, all_of_them = np.arange(len(seeds)), np.ones(len(seeds), bool)
    ends = np.abs(seeds.positions[:, 2]) > 0.12
    pieces = lost_pieces(seeds, identity, all_of_them, ~ends, spacing)
    assert len(pieces) == 2
    sides = [np.sign(p.positions[:, 2]) for p in pieces]
    assert all((s == s[0]).all() for s in sides) and sides[0][0] != sides[1][0]
    # one here and there is no piece, nor is what had been lost before
    scattered = np.random.default_rng(0).random(len(seeds)) < 0.2
    assert lost_pieces(seeds, identity, all_of_them, ~scattered, spacing) == ()
    assert lost_pieces(seeds, identity, ~ends, ~ends, spacing) == ()


def test_pieces_are_given_up_in_the_end(views, spacing, seeds):
    piece = LostPiece(np.arange(len(seeds)), seeds.positions, seeds.frames, looks=1000)
    none = np.zeros(len(seeds), bool)
    slack = hiding_depth(seeds, views[1], SETTINGS.slack_px)
    known = _found(seeds, 0)
    assert find_pieces((piece,), seeds, piece.identity, none, known, views[1], slack, spacing)[2] == ()
