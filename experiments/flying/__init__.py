"""Closed-loop flights in the simulator for several experiments."""
