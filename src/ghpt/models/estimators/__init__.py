"""Estimators of 3D joints: classical, RANSAC, learned; their uncertainty, left-right flips."""
