"""The exported C on emulated Cortex-M processors: reference images, what runs them, what they cost."""
