"""Estimators of 3D joints: classical, RANSAC, view weights; their uncertainty, left-right flips."""
