"""Identify a vehicle from logs of commands; see docs/howto/identify.md."""
