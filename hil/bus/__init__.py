"""The embedded CAN bus: wire model, hub and python-can plug-in."""

from hil.bus.wire_time import frame_bits as frame_bits
