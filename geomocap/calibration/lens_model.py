"""What is known of lenses beforehand, and which lens model the observations carry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomocap.calibration.bundle_adjustment import OPENCV, AdjustedNetwork, Prior, adjust, interior_indices
from geomocap.calibration.calibration_settings import BarSettings
from geomocap.calibration.covariance import covariance
from geomocap.calibration.projection import INTERIOR_NAMES, N_INTERIOR


@dataclass(frozen=True)
class Significance:
    """Test of a parameter that the final model does not have.

    Attributes
    ----------
    camera, parameter : str
    value, sigma : float
    """

    camera: str
    parameter: str
    value: float
    sigma: float

    @property
    def significant(self) -> bool:
        """Whether it differs from zero by more than 3.3 standard deviations (0.1 % of chance)."""
        return abs(self.value) > 3.3 * self.sigma


def weak_prior(sizes: np.ndarray, focal: np.ndarray, settings: BarSettings) -> Prior:
    """What every lens obeys: principal point near the middle, nearly square pixels, moderate distortion."""
    C = len(sizes)
    side = sizes.max(axis=1).astype(float)
    mean = np.zeros((C, N_INTERIOR))
    mean[:, 0] = mean[:, 1] = focal
    mean[:, 2:4] = sizes / 2
    sigma = np.full((C, N_INTERIOR), np.inf)
    sigma[:, 0] = sigma[:, 1] = settings.focal_sigma * focal
    sigma[:, 2] = sigma[:, 3] = settings.principal_point_sigma * side
    sigma[:, 4:6] = settings.radial_sigma
    sigma[:, 6:8] = settings.tangential_sigma
    sigma[:, 8:12] = settings.radial_sigma
    sigma[:, 12] = settings.aspect_sigma * focal
    return Prior(mean, sigma, settings.aspect_sigma * focal)


def choose_model(
    adjusted: AdjustedNetwork, prior: Prior, settings: BarSettings
) -> tuple[AdjustedNetwork, tuple[Significance, ...]]:
    """Test the parameters beyond OPENCV, and take k3 into the model if the observations ask for it.

    Shear (and k3 where it is not part of the model) is estimated in an extra adjustment and tested against its standard
    deviation; COLMAP's models have no shear, so it is reported only.
    """
    free = adjusted.columns.free_interior
    if not free:
        return adjusted, ()
    names = adjusted.network.names
    extra = interior_indices(("k3", "shear")) if settings.model != "FULL_OPENCV" else interior_indices(("shear",))
    wide = adjust(adjusted.network, tuple(sorted({*free, *extra})), prior, adjusted.loss)
    tests = tests_of(wide, extra)
    if settings.model == "auto":
        with_k3 = adjust(adjusted.network, (*free, *interior_indices(("k3",))), prior, adjusted.loss)
        gain = (adjusted.cost - with_k3.cost) / with_k3.sigma0**2
        # Each camera's k3 must earn its place against the number of observations (Schwarz's criterion)
        if gain > len(names) * np.log(2 * len(adjusted.network.bar)) and adjusted.sigma0 > 1.02 * with_k3.sigma0:
            adjusted = with_k3
    in_model = {INTERIOR_NAMES[p] for p in adjusted.columns.free_interior}
    return adjusted, tuple(t for t in tests if t.parameter not in in_model)


def tests_of(adjusted: AdjustedNetwork, parameters: tuple[int, ...]) -> tuple[Significance, ...]:
    """Return value and standard deviation of these interior parameters of every camera."""
    C = covariance(adjusted).cameras
    columns = adjusted.columns
    out = []
    for p in parameters:
        k = columns.free_interior.index(p)
        for c, name in enumerate(adjusted.network.names):
            column = columns.interior(c)[k]
            value = float(adjusted.network.interior[c, p])
            out.append(Significance(name, INTERIOR_NAMES[p], value, float(np.sqrt(C[column, column]))))
    return tuple(out)


def prior_for(
    sizes: np.ndarray, begin: AdjustedNetwork, given: np.ndarray | None, settings: BarSettings
) -> tuple[Prior, tuple[int, ...]]:
    """Prior and free parameters of the final model."""
    if given is not None:
        return Prior.none(len(sizes)), ()
    prior = weak_prior(sizes, begin.network.interior[:, 0], settings)
    free = OPENCV
    if settings.model == "FULL_OPENCV":
        free = interior_indices(INTERIOR_NAMES[:12])
    return prior, free
