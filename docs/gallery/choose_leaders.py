"""The best leaders of a grid whose rows and columns take turns, for every number of them."""

import matplotlib.pyplot as plt

from msg_analysis import Experiment

rows = [[i, i + 1] for i in range(1, 12) if i % 4]  # 1-2-3-4, 5-6-7-8, 9-10-11-12
columns = [[i, i + 4] for i in range(1, 9)]
experiment = Experiment.parse(
    {
        "name": "grid",
        "agents": 12,
        "graphs": {"rows": {"edges": rows}, "columns": {"edges": columns}},
        "switching": {"generator": [[-1, 1], [1, -1]]},
    }
)
best = []
for count in range(1, 5):
    selection = experiment.leaders(count)
    error, leaders = selection.sets[0]
    best.append(error)
    print(f"{count}: agents {', '.join(map(str, leaders))}, system error {error:.3f}")

figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
axes.plot(range(1, 5), best, marker="o")
axes.set(xlabel="number of leaders", ylabel="least system error", xticks=range(1, 5), ylim=0)
figure.savefig("choose_leaders.png", dpi=120)
