"""The exported C on emulated processors: reference images, what runs them, what they cost."""
