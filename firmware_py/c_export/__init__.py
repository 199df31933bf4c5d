"""C99 from the firmware's restricted Python: ``python -m firmware_py.c_export DIR``."""
