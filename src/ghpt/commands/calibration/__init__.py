"""From key points and intrinsics to a rig: the rooms of calibrate.py."""
