"""Reporting for all experiments: one table of results, one report, one style of figures. It imports no experiment.

rows = Results([{"model": "hybrid", "seed": 0, "test_mse": 0.02, "theta": {"Ix": 0.04}}, ...], tags=("model", "seed"))
rows.where(model="hybrid").spread("test_mse").mean    # a value that is not finite counts as infinite
verdicts = evaluate([Claim("C1", "The error is small.", lambda rows: (rows.spread("test_mse").mean < 1, "…"))], rows)
table = tabulate("Test error", rows.group("model"), {"L_MSE": lambda group: spread_text(group.spread("test_mse"))})
figures = {"scores": (legend_below(figure, "Scores"), "Test error against N")}
write_report(out, Report(record_of("mine", config, rows, seconds), figures, [table], claims=verdicts), Console())
"""
