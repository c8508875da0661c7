"""Partial differential equations with thousands of states: learned from one trajectory, and adapted to another."""
