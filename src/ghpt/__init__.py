"""Generalizable human pose triangulation: 3D people from 2D key points in several cameras."""

from importlib.metadata import version

__version__ = version("ghpt")
