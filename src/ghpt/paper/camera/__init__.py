"""The paper's tables and figures of the camera problem."""
