"""Articulated motion: bodies connected by joints, fitted to everything that is seen of them over all frames."""
