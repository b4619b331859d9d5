"""The same adjustment by Ceres through pycolmap and pyceres, to hold the project's own against.

pycolmap sets up the problem of images and points, the bars' lengths are added to it. pyceres is the optional extra
`solver`; nothing else needs it. All observations get one standard deviation, lenses no a-priori knowledge.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pycolmap

from geomocap.calibration.network import Network
from geomocap.calibration.projection import INTERIOR_NAMES, camera_of, interior_of
from geomocap.errors import CalibrationError


def adjust_with_ceres(network: Network, threads: int = 2) -> Network:
    """Adjust a network with Ceres (`OPENCV` cameras, least squares).

    Parameters
    ----------
    network : Network
        With approximate values; one view a camera.
    threads : int

    Returns
    -------
    network : Network
        At the solution, in the frame in which the first camera keeps its pose.

    Raises
    ------
    CalibrationError
        If pyceres is not installed, or Ceres finds no solution.
    """
    try:
        import pyceres
    except ImportError:
        raise CalibrationError("pyceres is not installed; pip install 'geomocap[solver]'") from None

    class Length(pyceres.CostFunction):
        """Residual of a bar's length."""

        def __init__(self, length: float, weight: float) -> None:
            pyceres.CostFunction.__init__(self)
            self.length, self.weight = length, weight
            self.set_num_residuals(1)
            self.set_parameter_block_sizes([3, 3])

        def Evaluate(self, parameters: Any, residual: Any, jacobians: Any) -> bool:
            """Compute the residual and its derivatives."""
            d = parameters[0] - parameters[1]
            n = np.sqrt(d @ d)
            residual[0] = (n - self.length) * self.weight
            if jacobians is not None:
                g = d * (self.weight / n)
                jacobians[0][:] = g
                jacobians[1][:] = -g
            return True

    n = network
    model = pycolmap.Reconstruction()
    point_of = 2 * n.bar + n.end
    position = np.zeros(len(n.bar), dtype=np.int64)
    for c, name in enumerate(n.names):
        camera = camera_of(n.interior[c], (int(n.sizes[c, 0]), int(n.sizes[c, 1])))
        camera.camera_id = c + 1
        model.add_camera_with_trivial_rig(camera)
        rows = np.flatnonzero(n.view == c)
        position[rows] = np.arange(len(rows))
        image = pycolmap.Image(name=name, keypoints=n.pixels[rows], camera_id=c + 1, image_id=c + 1)
        rotation = pycolmap.Rotation3d(np.array(n.rotation[c]))
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(rotation, np.array(n.translation[c])))
    identifiers = []
    for p, xyz in enumerate(n.bars.reshape(-1, 3)):
        track = pycolmap.Track()
        for m in np.flatnonzero(point_of == p):
            track.add_element(int(n.view[m]) + 1, int(position[m]))
        identifiers.append(model.add_point3D(xyz, track, np.zeros(3, np.uint8)))

    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.print_summary = False
    solver = options.ceres.solver_options
    solver.function_tolerance = solver.gradient_tolerance = solver.parameter_tolerance = 1e-14
    solver.max_num_iterations, solver.num_threads = 200, threads
    config = pycolmap.BundleAdjustmentConfig()
    for c in range(len(n.names)):
        config.add_image(c + 1)
    config.set_constant_rig_from_world_pose(model.images[1].frame_id)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    weight = float(np.mean(n.sigmas)) / n.length_sigma  # pycolmap's residuals are in pixels
    costs = [Length(n.length, weight) for _ in n.bars]
    for k, cost in enumerate(costs):
        ends = [model.points3D[identifiers[2 * k + e]].xyz for e in (0, 1)]
        adjuster.problem.add_residual_block(cost, None, ends)
    settings = options.ceres.create_solver_options(config, adjuster.problem)
    settings.num_threads, settings.minimizer_progress_to_stdout = threads, False
    summary = pyceres.SolverSummary()
    pyceres.solve(settings, adjuster.problem, summary)
    if not summary.IsSolutionUsable():
        raise CalibrationError(f"Ceres finds no solution: {summary.BriefReport()}")
    interior = n.interior.copy()
    for c in range(len(n.names)):
        interior[c, : len(INTERIOR_NAMES)] = interior_of(model.cameras[c + 1])
    poses = [model.images[c + 1].cam_from_world().matrix() for c in range(len(n.names))]
    points = np.array([model.points3D[i].xyz for i in identifiers]).reshape(-1, 2, 3)
    return n.with_state(interior, np.array([p[:, :3] for p in poses]), np.array([p[:, 3] for p in poses]), points)
