"""Robustness curves, which the paper lacks."""
