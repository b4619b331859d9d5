"""Segmentation of moving geometry into rigid bodies; it sees points only, never their source."""
