"""Studies of the closed loop: boxes of machines, linear analysis, tuning, the paper's evaluation."""
