"""Surface measurement: the images of one frame become a point cloud."""
