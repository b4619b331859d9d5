"""What is asked of a body."""

from __future__ import annotations

from dataclasses import dataclass

from geomocap.bodies.surface_noise import SurfaceNoise


@dataclass(frozen=True)
class Criterion:
    """When a body is one.

    Attributes
    ----------
    min_turn : float, radians
        It turns at least this much against each neighbour, or slides as far, beyond what noise feigns;
    noise : SurfaceNoise
        blends of its neighbours miss its samples by more than this noise and its freedoms are worth;
    min_fraction : float
        of fewer samples than this fraction, it needs as much more evidence.
    softness : float
        Soft skin differs from a blend of two bodies by up to this fraction of how far these turn it apart.
    """

    min_turn: float
    noise: SurfaceNoise
    min_fraction: float
    softness: float
