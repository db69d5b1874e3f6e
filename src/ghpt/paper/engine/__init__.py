"""Tasks that are computed once and kept, artefacts made of them, and one report."""
