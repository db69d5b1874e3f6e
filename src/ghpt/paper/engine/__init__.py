"""Cells that are computed once and kept, items made of them, and one report."""
