"""What studies the closed loop rather than being the bench: parameter boxes, sweeps, tuning, reports."""
