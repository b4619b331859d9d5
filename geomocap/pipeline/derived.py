"""Files and folders that are made from a stage's results by others, and go when these results go."""

from geomocap.export.run_export import FILES

KEYPOINT_FILES = ("keypoints.npz", "keypoints.trc", "keypoints.c3d")  # from tracks, or from nodes of the bodies
FROM_BODIES = (*KEYPOINT_FILES, *FILES.values(), "review")
