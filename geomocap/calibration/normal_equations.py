"""Normal equations of the bar adjustment, reduced bar by bar to the camera unknowns (Schur complement).

The two ends of a bar are tied by its known length only, so the points' part of the normal matrix consists of 6×6
blocks, one a bar. Everything is summed in a fixed order: the same input gives the same bits.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from geomocap.calibration.projection import project_point


@njit(cache=True, nogil=True, error_model="numpy")
def linearize(
    interior,
    view_camera,
    rotation,
    translation,
    bars,
    bar,
    view,
    end,
    pixels,
    sigmas,
    group,
    n_groups,
    free,
    length,
    length_sigma,
    loss,
):
    """Build the blocks of the normal equations.

    Parameters
    ----------
    interior … length_sigma :
        As in `Network`; `group` (M,) int numbers the (bar, view) pairs in order, `free` (F,) int lists the free
        parameters of a view among the 19 (13 interior, 6 pose).
    loss : float
        Scale of the pseudo-Huber loss in standard deviations; 0 for least squares.

    Returns
    -------
    cost : float
        Sum of the (robustified) squared normalised residuals; infinite if a point is behind a camera.
    U : (V, F, F) float
        Camera blocks, view by view.
    gc : (V, F) float
    Vp : (P, 6, 6) float
        Blocks of the bars.
    gp : (P, 6) float
    W : (n_groups, F, 6) float
        Blocks between view and bar.
    """
    n_views, n_free = len(view_camera), len(free)
    n_bars = len(bars)
    U = np.zeros((n_views, n_free, n_free))
    gc = np.zeros((n_views, n_free))
    Vp = np.zeros((n_bars, 6, 6))
    gp = np.zeros((n_bars, 6))
    W = np.zeros((n_groups, n_free, 6))
    J = np.empty((2, 22))
    A = np.empty((2, n_free))
    xy = np.empty(2)
    cost = 0.0
    for m in range(len(bar)):
        p, v, e = bar[m], view[m], end[m]
        if not project_point(interior[view_camera[v]], rotation[v], translation[v], bars[p, e], xy, J):
            return np.inf, U, gc, Vp, gp, W
        w = 1.0 / sigmas[m]
        r0, r1 = (xy[0] - pixels[m, 0]) * w, (xy[1] - pixels[m, 1]) * w
        s = r0 * r0 + r1 * r1
        if loss > 0.0:
            a = np.sqrt(1.0 + s / (loss * loss))
            cost += 2.0 * loss * loss * (a - 1.0)
            f = 1.0 / np.sqrt(a)
            r0 *= f
            r1 *= f
            w *= f
        else:
            cost += s
        for k in range(n_free):
            A[0, k] = J[0, free[k]] * w
            A[1, k] = J[1, free[k]] * w
        for k in range(19, 22):
            J[0, k] *= w
            J[1, k] *= w
        g = group[m]
        for a_ in range(n_free):
            gc[v, a_] += A[0, a_] * r0 + A[1, a_] * r1
            for b in range(n_free):
                U[v, a_, b] += A[0, a_] * A[0, b] + A[1, a_] * A[1, b]
            for b in range(3):
                W[g, a_, 3 * e + b] += A[0, a_] * J[0, 19 + b] + A[1, a_] * J[1, 19 + b]
        for a_ in range(3):
            gp[p, 3 * e + a_] += J[0, 19 + a_] * r0 + J[1, 19 + a_] * r1
            for b in range(3):
                Vp[p, 3 * e + a_, 3 * e + b] += J[0, 19 + a_] * J[0, 19 + b] + J[1, 19 + a_] * J[1, 19 + b]
    g6 = np.empty(6)
    for p in range(n_bars):
        d = bars[p, 0] - bars[p, 1]
        n = np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
        r = (n - length) / length_sigma
        cost += r * r
        for a_ in range(3):
            g6[a_] = d[a_] / (n * length_sigma)
            g6[3 + a_] = -g6[a_]
        for a_ in range(6):
            gp[p, a_] += g6[a_] * r
            for b in range(6):
                Vp[p, a_, b] += g6[a_] * g6[b]
    return cost, U, gc, Vp, gp, W


@njit(cache=True, nogil=True, error_model="numpy")
def residuals(interior, view_camera, rotation, translation, bars, bar, view, end, pixels):
    """Project all observed points: (M, 2) float, computed minus observed, pixels; NaN behind a camera."""
    J = np.empty((2, 22))
    xy = np.empty(2)
    out = np.empty((len(bar), 2))
    for m in range(len(bar)):
        v = view[m]
        if project_point(interior[view_camera[v]], rotation[v], translation[v], bars[bar[m], end[m]], xy, J):
            out[m, 0] = xy[0] - pixels[m, 0]
            out[m, 1] = xy[1] - pixels[m, 1]
        else:
            out[m] = np.nan
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def reduce_bars(Vp, gp, W, group_view, bar_groups, n_views, damping):
    """Eliminate the bars.

    Parameters
    ----------
    Vp, gp, W : from `linearize`
    group_view : (n_groups,) int
    bar_groups : (P + 1,) int
        Where the groups of each bar begin.
    n_views : int
    damping : float
        Marquardt's factor on the diagonal.

    Returns
    -------
    S : (V, V, F, F) float
        What the bars take away from the cameras' normal matrix; blocks with first view <= second are set.
    b : (V, F) float
        What they take away from the right-hand side.
    inverse : (P, 6, 6) float
        Inverse damped blocks of the bars.
    """
    n_free = W.shape[1]
    S = np.zeros((n_views, n_views, n_free, n_free))
    b = np.zeros((n_views, n_free))
    inverse = np.empty_like(Vp)
    T = np.empty((n_free, 6))
    block = np.empty((6, 6))
    for p in range(len(Vp)):
        block[:] = Vp[p]
        for k in range(6):
            block[k, k] *= 1.0 + damping
        inv = np.linalg.inv(block)
        inverse[p] = inv
        for g in range(bar_groups[p], bar_groups[p + 1]):
            v = group_view[g]
            for i in range(n_free):
                for k in range(6):
                    total = 0.0
                    for j in range(6):
                        total += W[g, i, j] * inv[j, k]
                    T[i, k] = total
                total = 0.0
                for k in range(6):
                    total += T[i, k] * gp[p, k]
                b[v, i] += total
            for h in range(g, bar_groups[p + 1]):
                target = S[v, group_view[h]]
                for i in range(n_free):
                    t0, t1, t2, t3, t4, t5 = T[i, 0], T[i, 1], T[i, 2], T[i, 3], T[i, 4], T[i, 5]
                    for j in range(n_free):
                        w = W[h, j]
                        target[i, j] += t0 * w[0] + t1 * w[1] + t2 * w[2] + t3 * w[3] + t4 * w[4] + t5 * w[5]
    return S, b, inverse


@njit(cache=True, nogil=True, error_model="numpy")
def back_substitute(inverse, gp, W, group_view, bar_groups, step):
    """Return the bars' step (P, 6) that goes with the views' step (V, F)."""
    out = np.empty_like(gp)
    right = np.empty(6)
    n_free = W.shape[1]
    for p in range(len(gp)):
        right[:] = gp[p]
        for g in range(bar_groups[p], bar_groups[p + 1]):
            v = group_view[g]
            for i in range(n_free):
                for k in range(6):
                    right[k] += W[g, i, k] * step[v, i]
        for k in range(6):
            total = 0.0
            for j in range(6):
                total += inverse[p, k, j] * right[j]
            out[p, k] = -total
    return out
