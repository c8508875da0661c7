"""Recorded flights: reading logs, checking what they claim to be, cleaning them and cutting them into windows."""
