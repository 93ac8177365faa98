"""Experiments for tests of the theory: the line and the ring, and random graphs under random chains."""

import itertools

import networkx as nx
import numpy as np
import scipy.linalg

from experiments import document
from msg_analysis.experiment.experiment import Experiment
from msg_analysis.experiment.markov_chain import stationary_law
from msg_analysis.theory.jump_system import JumpSystem
from msg_analysis.theory.moments import MomentSolver

LINE_RING = document(5, 0.5, noise={"process": 1.0}, run={"duration": 10, "replicas": 1})


def network(
    seed, m, n, *, time="continuous", problem="consensus", directed=True, noise=None, rate=1.0, gain=0.8, dt=0.05
):
    """Random weighted graphs, each of which holds all agents together, and a random chain; noise None: correlated."""
    random = np.random.default_rng(seed)
    graphs = {}
    for i in range(n):
        order = (random.permutation(m) + 1).tolist()
        pairs = [*itertools.pairwise(order), *random.integers(1, m + 1, (m // 2, 2)).tolist()]
        if directed:
            pairs.append((order[-1], order[0]))
        links = {tuple(pair) if directed else tuple(sorted(pair)) for pair in pairs if pair[0] != pair[1]}
        kind = "arcs" if directed else "edges"
        graphs[f"g{i}"] = {kind: [[*pair, float(random.uniform(0.3, 1.5))] for pair in sorted(links)]}
    chain = rate * random.uniform(0.1, 1.0, (n, n))
    if time == "continuous":
        np.fill_diagonal(chain, 0.0)
        switching = {"generator": (chain - np.diag(chain.sum(axis=1))).tolist()}
    else:
        switching = {"transition": (chain / chain.sum(axis=1, keepdims=True)).tolist()}
    document = {
        "name": "random",
        "problem": problem,
        "time": time,
        "agents": m,
        "graphs": graphs,
        "switching": switching | {"initial": "g0"},
        "noise": {"process": random.standard_normal((m, m)).tolist() if noise is None else noise},
        "run": {"dt": dt, "duration": 100 * dt} if time == "continuous" else {"duration": 10},
    }
    if problem == "tracking":
        document["leaders"] = {"agents": [1], "gain": gain, "reference": 2.0}
    return Experiment.parse(document)


def steady_of(system):
    return MomentSolver(system).steady()


def generator(random, n, rate=1.0, *, reversible=False):
    flow = random.uniform(0.05, 2.0, (n, n)) * rate
    if reversible:
        flow = (flow + flow.T) / random.uniform(0.2, 1.0, n)[:, None]
    np.fill_diagonal(flow, 0.0)
    return flow - np.diag(flow.sum(axis=1))


def laplacian(random, m, kind):
    a = np.zeros((m, m))
    if kind == "pieces":  # a few edges only: disconnected; the union is made to hold together below
        for i, j in random.integers(m, size=(max(1, m // 3), 2)):
            a[i, j] = a[j, i] = 1.0
    elif kind == "chain":  # everybody hears the one before: no eigenvectors
        a[range(1, m), range(m - 1)] = 1.0
    else:
        a = random.uniform(0.2, 1.5, (m, m)) * (random.random((m, m)) < 3.0 / m)
        a[range(1, m), range(m - 1)] = 1.0
        if kind == "symmetric":
            a = a + a.T
    np.fill_diagonal(a, 0.0)
    return np.diag(a.sum(axis=1)) - a


def system(random, m, gamma, kind="symmetric", dt=None, loss=False):
    """Consensus; with dt in discrete time."""
    n = len(gamma)
    z = np.stack([laplacian(random, m, kind) for _ in range(n)])
    if kind == "pieces":
        z[0] += nx.laplacian_matrix(nx.path_graph(m)).toarray()
    f = random.standard_normal((n, m, m))
    lift = scipy.linalg.helmert(m).T
    noise, law = lift.T @ (f @ f.transpose(0, 2, 1)) @ lift, stationary_law(gamma)
    if dt is None:
        return JumpSystem("continuous", lift.T @ z @ lift, noise, gamma, law, lift)
    chain = np.clip(scipy.linalg.expm(scipy.linalg.block_diag(gamma * dt, 0.0))[:n, :n], 0.0, None)
    chain /= chain.sum(axis=1, keepdims=True)
    variance = 0.2 * (dt * z * ~np.eye(m, dtype=bool)) ** 2 if loss else None
    return JumpSystem("discrete", np.eye(m - 1) - dt * lift.T @ z @ lift, noise, chain, law, lift, variance)
