"""The key-point problem: how much each key point is worth in one triangulation of the pose."""
