"""pycolmap, without its handler of SIGTERM, which prints the stack of the C++ code."""

import pycolmap

from ghpt.signals import give_back

give_back()

__all__ = ["pycolmap"]
