"""The bench: bus, runs, scenarios, measurements, reports."""
