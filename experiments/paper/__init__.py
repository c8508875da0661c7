"""The paper's experiments: pre-train on a source, adapt to a target with N trajectories, test."""
