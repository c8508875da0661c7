"""Public records for system identification of which not every state was measured, each with a program."""
