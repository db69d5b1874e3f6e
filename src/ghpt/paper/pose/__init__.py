"""The paper's tables and figures of the pose problem."""
