"""Calibration of a whole rig from the people in view: known intrinsics and key points give all
extrinsics.
"""
