"""The paper's tables and figures again: tasks, artefacts that are made of them, and one report."""
