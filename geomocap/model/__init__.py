"""The nouns: cameras, geometry, paths, ellipsoids, skeleton, surface. Values that know no files."""
