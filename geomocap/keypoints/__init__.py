"""Key-points: regions placed on the surface and carried by the trajectories in them."""
