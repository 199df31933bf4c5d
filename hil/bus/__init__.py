"""The embedded CAN bus: wire model, hub and python-can plug-in."""
