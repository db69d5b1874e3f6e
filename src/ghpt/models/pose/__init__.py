"""The pose problem (paper, section 3.1)."""
