"""Worlds: true systems that fly as they are asked to, and the logs that a real vehicle would give of it.

A world is a value that flies; see `world.World`. There are the project's own simulator and two vehicles of RotorPy.
"""
