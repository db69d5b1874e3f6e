"""The joint problem: the paper's idea for each joint, in the pose around it."""
