"""A run of the twin against its prediction, and three runs with other seeds together."""

from msg_analysis import Experiment, compare, write_report

experiment = Experiment.parse(
    {
        "name": "line_ring",
        "graphs": {"line": {"path": [1, 2, 3, 4, 5]}, "ring": {"cycle": [1, 2, 3, 4, 5]}},
        "switching": {"generator": [[-0.5, 0.5], [0.5, -0.5]]},
        "run": {"dt": 0.05, "duration": 200, "replicas": 16, "seed": 7},
    }
)
comparison = experiment.simulate().compare()
print(comparison)
for test in comparison.tests:
    print(f"{test.name:24} p {test.p:.3f}, adjusted {test.p_adjusted:.3f}")
write_report(comparison, "report.html")

together = compare(*(experiment.simulate(seed=seed) for seed in (1, 2, 3)))
print(together)
errors = [result.system_error.standard_error for result in (comparison, together)]
print("standard error of one run {:.4f}, of the three together {:.4f}".format(*errors))
