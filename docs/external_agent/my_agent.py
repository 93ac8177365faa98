"""An agent of a run as a program of one's own: python my_agent.py RUN_RECORD AGENT [GAIN]."""

import sys

import numpy as np

from msg_agents import ExternalAgent


class MyAgent(ExternalAgent):
    """It obeys the built-in law: Euler steps, with noise of its own."""

    gain = 1.0
    random = np.random.default_rng()

    def step(self, k, graph, own, heard):  # noqa: ARG002
        """Next state; this law is the same in every step."""
        dt, me = self.experiment.step_length, self.number - 1
        pull = sum(graph.adjacency[me, j - 1] * (value - own) for j, value in heard.items())
        noise = self.experiment.noise_gain[0][me, me] * np.sqrt(dt) * self.random.standard_normal(len(own))
        return own + self.gain * dt * pull + noise


if __name__ == "__main__":
    agent = MyAgent(sys.argv[1], int(sys.argv[2]))
    agent.random = np.random.default_rng([1, agent.number])  # the same numbers every time
    agent.gain = float(sys.argv[3]) if len(sys.argv) > 3 else 1.0
    agent.run()
