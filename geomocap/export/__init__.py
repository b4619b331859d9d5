"""Motion files: BVH, TRC, C3D, glTF, USD, CSV."""
