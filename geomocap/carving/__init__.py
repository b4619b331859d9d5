"""Space carving: silhouettes to coloured surface voxels."""
