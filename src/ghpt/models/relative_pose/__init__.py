"""The camera problem (paper, section 3.2)."""
