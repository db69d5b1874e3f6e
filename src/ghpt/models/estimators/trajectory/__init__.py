"""A person's trajectory: robust reprojection, smooth motion and constant bones, solved at once."""
