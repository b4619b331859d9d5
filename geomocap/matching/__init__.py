"""Least squares matching: kernels, seeds, growing."""
