"""`python -m experiments.real_flight`: train on recorded flights, adapt to a change, test on held-out flights."""
