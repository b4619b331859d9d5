import numpy as np

from geomocap.model.outline_points import OutlinePoints, outline_points

MIDDLE, RADIUS = np.array([60.0, 50.0]), 30.0


def ball(size=(100, 120), middle=MIDDLE):
    y, x = np.mgrid[: size[0], : size[1]]
    return np.clip(RADIUS + 0.5 - np.hypot(x - middle[0], y - middle[1]), 0.0, 1.0).astype(np.float32)


def test_points_lie_on_the_outline_and_point_outwards():
    mask = ball()
    found = outline_points(mask, np.ones_like(mask), 4)
    away = found[:, :2] - MIDDLE
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), RADIUS, atol=0.8)
    assert abs(np.linalg.norm(away, axis=1).mean() - RADIUS) < 0.2
    np.testing.assert_allclose((away * found[:, 2:]).sum(axis=1) / np.linalg.norm(away, axis=1), 1.0, atol=0.02)
    assert 40 < len(found) < 60


def test_a_hole_has_an_outline_into_it():
    mask = 1.0 - ball()
    found = outline_points(mask, np.ones_like(mask), 4)
    away = found[:, :2] - MIDDLE
    assert ((away * found[:, 2:]).sum(axis=1) < 0).all()
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), RADIUS, atol=0.8)


def test_where_the_image_ends_is_no_outline():
    mask = ball(middle=np.array([10.0, 50.0]))
    valid = np.ones_like(mask)
    valid[:30] = 0
    found = outline_points(mask * valid, valid, 2)
    assert len(found) and found[:, 0].min() > 3 and found[:, 1].min() > 32


def test_specks_and_empty_silhouettes_have_none():
    empty = np.zeros((40, 40), np.float32)
    speck = empty.copy()
    speck[10:12, 10:12] = 1
    for mask in (empty, speck):
        assert outline_points(mask, np.ones_like(mask), 4).shape == (0, 4)


def test_centers_are_where_cameras_stand():
    P = np.array([[[300.0, 0, 50, 0], [0, 300, 50, 0], [0, 0, 1, 0]]])
    P[0, :, 3] = -P[0, :, :3] @ [0.1, 0.2, -3.0]
    np.testing.assert_allclose(OutlinePoints(P, []).centers, [[0.1, 0.2, -3.0]], atol=1e-12)
