"""Makes the trace of the example recorded_robots: six robots that drive to random places of a square, one row a second.

.venv/bin/python benchmarks/recorded_robots.py > analysis/msg_analysis/experiment/bundled/recorded_robots.csv
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

ROBOTS, SECONDS, SIDE, SPEED, SEED = 6, 120, 10.0, 0.5, 3


def rows() -> Iterator[str]:
    """The lines of the file."""
    rng = np.random.default_rng(SEED)
    places, aims = rng.uniform(0.0, SIDE, (2, ROBOTS, 2))
    yield "time,agent,x,y"
    for time in range(SECONDS):
        for robot in range(ROBOTS):
            yield f"{time},r{robot + 1},{places[robot, 0]:.2f},{places[robot, 1]:.2f}"
            way = aims[robot] - places[robot]
            left = float(np.hypot(*way))
            if left > SPEED:
                places[robot] += way * (SPEED / left)
            else:
                places[robot], aims[robot] = aims[robot], rng.uniform(0.0, SIDE, 2)


if __name__ == "__main__":
    print("\n".join(rows()))
