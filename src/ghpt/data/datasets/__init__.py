"""Data sets as recordings, their cache on disk, and the DataModules that serve them."""
