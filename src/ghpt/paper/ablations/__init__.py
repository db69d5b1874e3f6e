"""Ablations: one setting of the pose model changed at a time."""
