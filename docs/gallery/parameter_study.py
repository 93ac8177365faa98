"""A parameter by hand: how the rate of switching changes the system error, in continuous time and in steps."""

import matplotlib.pyplot as plt
import numpy as np

from msg_analysis import Experiment

document = {
    "name": "line_ring",
    "graphs": {"line": {"path": [1, 2, 3, 4, 5]}, "ring": {"cycle": [1, 2, 3, 4, 5]}},
    "run": {"dt": 0.05, "duration": 400, "seed": 7},
}
rates = np.geomspace(0.01, 100, 25)  # 1 / unit of simulated time
predictions = []
for rate in rates.tolist():
    switching = {"generator": [[-rate, rate], [rate, -rate]]}
    predictions.append(Experiment.parse({**document, "switching": switching}).predict())

figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
axes.semilogx(rates, [p.continuous.system_error for p in predictions], label="continuous time")
axes.semilogx(rates, [p.emulated.system_error for p in predictions], label="steps of 0.05")
axes.axhline(predictions[0].static.system_error, color="black", linestyle="--", label="graphs held fixed")
axes.set(xlabel="rate of switching", ylabel="system error")
axes.legend()
figure.savefig("parameter_study.png", dpi=120)
print(f"slow {predictions[0].continuous.system_error:.4f}, fast {predictions[-1].continuous.system_error:.4f}")
