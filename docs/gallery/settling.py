"""How long until a network that starts apart has settled: mean-square errors over time, exactly."""

import matplotlib.pyplot as plt
import numpy as np

from msg_analysis import Experiment

experiment = Experiment.parse(
    {
        "name": "apart",
        "graphs": {"left": {"path": [1, 2, 3]}, "right": {"path": [3, 4, 5]}},
        "agents": 5,
        "switching": {"generator": [[-0.5, 0.5], [0.5, -0.5]]},
        "run": {"dt": 0.05, "duration": 400, "seed": 7, "start": [5, 2, 0, 0, -2]},
    }
)
course = experiment.transient(np.arange(0, 20.5, 0.5))
print(course)
print("errors of the agents at the end:", np.round(course.node_errors[-1], 3))

figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
axes.plot(course.times, course.node_errors, label=[f"agent {i}" for i in range(1, 6)])
axes.set(xlabel="simulated time", ylabel="mean-square error", ylim=0)
axes.legend(ncols=2)
figure.savefig("settling.png", dpi=120)
