"""Checks of logs against themselves and against a vehicle, and the cleaning of what they find."""
