"""Which agent knows best where the others are? Node certainty 1/E_i of every agent, switching and not."""

import matplotlib.pyplot as plt
import numpy as np

from msg_analysis import Experiment

experiment = Experiment.parse(
    {
        "name": "line_ring",
        "graphs": {"line": {"path": [1, 2, 3, 4, 5]}, "ring": {"cycle": [1, 2, 3, 4, 5]}},
        "switching": {"generator": [[-0.5, 0.5], [0.5, -0.5]]},
        "run": {"dt": 0.05, "duration": 400, "replicas": 16, "seed": 7},
    }
)
prediction = experiment.predict()
print(prediction)

agents = np.arange(1, experiment.agents + 1)
figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
axes.bar(agents - 0.2, prediction.continuous.node_certainty, 0.4, label="switching")
axes.bar(agents + 0.2, prediction.static.node_certainty, 0.4, label="each graph held fixed, mean")
axes.set(xlabel="agent", ylabel="node certainty 1/E", xticks=agents)
axes.set_ylim(0, 7)
axes.legend()
figure.savefig("node_certainty.png", dpi=120)
