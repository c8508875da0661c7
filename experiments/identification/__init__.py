"""Public records for system identification in which only some states were measured, each with a program."""
