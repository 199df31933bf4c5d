"""The contract on the bus: frames, codecs, end-to-end protection. Imports nothing of ours."""
