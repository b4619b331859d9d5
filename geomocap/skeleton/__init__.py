"""Joints, hierarchy and motion of segmented bodies."""
