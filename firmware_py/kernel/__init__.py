"""Control kernel in restricted Python: integers only, flat int32 arrays, no allocation, C-like widths."""
