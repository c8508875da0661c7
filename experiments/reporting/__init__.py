"""Reporting for all experiments: one table of results, one report, one style of figures. It imports no experiment.

rows = Results([{"model": "hybrid", "n_train": 100, "seed": 0, "test_mse": 0.02, "theta": {"Ix": 0.04}}, ...],
               tags=("model", "n_train", "seed"))
few = rows.where(n_train=100)
few.where(model="hybrid").spread("test_mse").mean     # a value that is not finite counts as infinite
rows.numbers("theta.Ix")                              # nested columns by dotted path; functions of a row work too
difference = mean_difference(*few.where(model="hybrid").paired(few.where(model="no_physics"), "test_mse"))

def smaller(rows):                                    # raises Inconclusive("…") where rows are missing
    means = [rows.where(model=m).spread("test_mse").mean for m in ("hybrid", "no_physics")]
    return means[0] < means[1], f"{means[0]:.3g}, {means[1]:.3g}"

verdicts = evaluate([Claim("C1", "The hybrid's mean error is smaller.", smaller)], few)
error = lambda group: spread_text(group.spread("test_mse"), ".2e", ".1e")
table = tabulate("Test error", few.group("model"), {"L_MSE": error})   # or cross_table(…) for lines × columns
figures = save_figures(out, {"scores": (legend_below(figure, "Scores"), "Test error against N")})
write_report(out, Report("mine", config, environment(seconds), rows, verdicts, figures, ["A note."],
             head="# mine", tables=[table, verdict_table(verdicts, "Claims")]), Console())
"""
