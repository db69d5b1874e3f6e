"""Tasks that are run once and kept, artefacts that are made of them, and one report."""
