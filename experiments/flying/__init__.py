"""Closed-loop flights in the simulator, which several experiments fly."""
