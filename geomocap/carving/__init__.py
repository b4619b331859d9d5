"""Space carving: silhouettes to surface voxels."""
