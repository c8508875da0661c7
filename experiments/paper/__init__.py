"""The paper's experiments: pre-train on a source, adapt to a target with N trajectories, test.

- `config`: options and presets. `conditions`: initial models and hyper-parameters of every run, measurement noise.
- `study`: the protocol. `methods`: the methods of the comparison. `lanes`: tested models and their rows.
- `claims`, `tables`, `figures`, `flight_figures`, `outcome`: the report.
"""
