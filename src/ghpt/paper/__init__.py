"""The paper's tables and figures again: tasks that are computed once and kept, artefacts made of them,
one report.
"""
