"""Foreign key points and cameras, read and written."""
