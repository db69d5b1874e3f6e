"""When the cameras' frames were taken: starts, rates and parts of a frame, from people who move."""
