"""Pure functions on tensors: cameras, rotations, lenses, triangulation, epipolar geometry."""
