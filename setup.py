"""The packages of the wheel: those of src, and the folder conf as ``ghpt.conf``."""

from setuptools import find_packages, setup

setup(packages=[*find_packages("src"), "ghpt.conf"])
