"""Three ways to run the same nodes: in one process, in lock-step, in real time."""
