"""What would be flashed: the integer controller and, host side, its tuning."""
