"""Worlds: true systems (the project's own simulator and two vehicles of RotorPy) with the logs of a real vehicle."""
