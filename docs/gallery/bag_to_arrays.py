"""A bag into arrays: states, graphs and times, and what is missing. The bag may be a network's or the twin's."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from msg_analysis import Experiment, read_bag

experiment = Experiment.parse(
    {
        "name": "tracking",
        "problem": "tracking",
        "graphs": {"line": {"path": [1, 2, 3, 4, 5]}, "ring": {"cycle": [1, 2, 3, 4, 5]}},
        "switching": {"generator": [[-0.5, 0.5], [0.5, -0.5]]},
        "leaders": {"agents": [3], "gain": 1.0, "reference": 2.0},
        "run": {"dt": 0.05, "duration": 40, "replicas": 4, "seed": 7, "start": "zero"},
    }
)
if not Path("tracking_twin").exists():
    experiment.simulate().save("tracking_twin")

run = read_bag("tracking_twin")
print(run)
print(run.completeness)
print("states", run.states.shape, "graphs", run.modes.shape, "times", run.times.shape)

figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
axes.plot(run.times, run.states[:, :, 0], linewidth=0.8)  # the first replica of every agent
ring, whole = run.modes == 1, axes.get_xaxis_transform()
axes.fill_between(run.times[:-1], 0, 1, where=ring, transform=whole, alpha=0.15, label="ring")
axes.axhline(run.experiment.reference, color="black", linestyle="--", label="reference")
axes.set(xlabel="simulated time", ylabel="state", xlim=(0, 40))
axes.legend(loc="upper center", ncols=2, bbox_to_anchor=(0.5, 1.2))
figure.savefig("bag_to_arrays.png", dpi=120)

errors = ((run.states - run.experiment.reference) ** 2).mean(axis=2)  # (N + 1, m), mean over the replicas
print("mean square from the reference, second half:", np.round(errors[len(errors) // 2 :].mean(axis=0), 3))
print("predicted for all time:                     ", np.round(run.experiment.predict().emulated.node_errors, 3))
