"""Faults: small declarative objects, from a scenario file, a test or the command line."""
