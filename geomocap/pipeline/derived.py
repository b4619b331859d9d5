"""Files that are made from a stage's results by others, and go when these results go."""

KEYPOINT_FILES = ("keypoints.npz", "keypoints.trc", "keypoints.c3d")  # from tracks, or from nodes of the bodies
