"""The paper's tables and figures again: cells that are computed once and kept, items made of them,
one report.
"""
