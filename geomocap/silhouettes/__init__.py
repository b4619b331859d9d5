"""Background model of a camera, and the silhouettes of what stands before it, as all cameras decide together."""
