"""Second moments against the same equations in 80 digits, at extreme rates and gains."""

import importlib.util
from decimal import Decimal, localcontext
from pathlib import Path

import mpmath
import numpy as np
import pytest
import scipy.linalg
from digits import DIGITS, exactly, solve

from experiments import TRACKING, line_ring, predict
from msg_analysis.errors import InputError
from msg_analysis.experiment.markov_chain import stationary_law
from msg_analysis.theory.jump_system import JumpSystem
from msg_analysis.theory.moments import MomentSolver
from msg_analysis.theory.solvers import IterativeSolver

RATES = [1e-8, 1e-4, 1.0, 1e3, 1e6]
GAINS = [1e-3, 1.0, 1e3, 1e6]

PATH = [[1.0, -1, 0, 0], [-1, 2, -1, 0], [0, -1, 2, -1], [0, 0, -1, 1]]
RING = [[2.0, -1, 0, -1], [-1, 2, -1, 0], [0, -1, 2, -1], [-1, 0, -1, 2]]
PAIRS = [[1.0, -1, 0, 0], [-1, 1, 0, 0], [0, 0, 1, -1], [0, 0, -1, 1]]
BRIDGE = [[0.0, 0, 0, 0], [0, 1, -1, 0], [0, -1, 1, 0], [0, 0, 0, 0]]
LISTEN = [[0.0, 0, 0, 0], [-0.5, 0.5, 0, 0], [0, -2, 2, 0], [-1, 0, -0.25, 1.25]]
STAR = [[3.0, -1, -1, -1], [-1, 1, 0, 0], [-1, 0, 1, 0], [-1, 0, 0, 1]]

CHAINS = {
    "even": [[-1.0, 1.0], [1.0, -1.0]],
    "uneven": [[-0.001, 0.001], [2.0, -2.0]],
    "one way round": [[-1.0, 1.0, 0.0], [0.0, -2.0, 2.0], [0.5, 0.0, -0.5]],
}


def helmert(m):
    """(m - 1, m) in many digits."""
    rows = np.zeros((m - 1, m), dtype=object)
    for k in range(1, m):
        rows[k - 1, :k] = 1 / Decimal(k * (k + 1)).sqrt()
        rows[k - 1, k] = -k / Decimal(k * (k + 1)).sqrt()
    return rows


def exact(laplacians, gains, generator):
    """(m, m) covariance: every step in 80 digits, nothing symmetric assumed, Q = I."""
    with localcontext(prec=DIGITS):
        m, n = len(laplacians[0]), len(generator)
        basis = exactly(np.eye(m)) if any(gains) else helmert(m)
        z = [basis @ (exactly(a) + exactly(np.diag(gains))) @ basis.T for a in laplacians]
        chain = exactly(generator)
        for i in range(n):  # rows sum to zero in all digits, too
            chain[i, i] = -sum(chain[i, j] for j in range(n) if j != i)
        balance = chain.T.copy()
        balance[n - 1] = 1
        law = solve(balance, exactly([0] * (n - 1) + [1]))
        d = len(basis)
        eye = exactly(np.eye(d))
        # The columns of C_i one above the other, of one graph after the other
        matrix = np.kron(-chain.T, np.kron(eye, eye))
        for i in range(n):
            own = slice(i * d * d, (i + 1) * d * d)
            matrix[own, own] += np.kron(z[i], eye) + np.kron(eye, z[i])
        solution = solve(matrix, np.kron(law, eye.ravel()))
        return (basis.T @ solution.reshape(n, d, d).sum(axis=0) @ basis).astype(float)


def double(laplacians, gains, generator):
    """(m, m) covariance by the solver, which is not the dense one."""
    m = len(laplacians[0])
    lift = np.eye(m) if any(gains) else scipy.linalg.helmert(m).T
    z = lift.T @ (np.array(laplacians) + np.diag(gains)) @ lift
    chain = np.array(generator)
    noise = np.stack([np.eye(lift.shape[1])] * len(chain))
    system = JumpSystem("continuous", z, noise, chain, stationary_law(chain), lift)
    return system.lifted(IterativeSolver(system).steady().sum(axis=0))


def worst(measured, expected):
    """Largest relative error of node and system errors, and of the matrix in its norm."""
    nodes = np.abs(np.diag(measured) / np.diag(expected) - 1).max()
    whole = np.linalg.norm(measured - expected, 2) / np.linalg.norm(expected, 2)
    return max(nodes, abs(np.trace(measured) / np.trace(expected) - 1), whole)


def scaled(name, rate):
    return (np.array(CHAINS[name]) * rate).tolist()


GRAPHS = {"connected": [PATH, RING, STAR], "disconnected": [PAIRS, BRIDGE, BRIDGE], "directed": [LISTEN, RING, STAR]}


@pytest.mark.parametrize("chain", CHAINS)
@pytest.mark.parametrize("graphs", GRAPHS)
@pytest.mark.parametrize("rate", [*RATES, 1e10])
def test_consensus(graphs, chain, rate):
    laplacians, generator = GRAPHS[graphs][: len(CHAINS[chain])], scaled(chain, rate)
    measured = double(laplacians, [0.0] * 4, generator)
    assert worst(measured, exact(laplacians, [0.0] * 4, generator)) < (1e-9 if rate <= 1e6 else 1e-7)


@pytest.mark.parametrize("gain", GAINS)
@pytest.mark.parametrize("rate", [*RATES, 1e10])
def test_tracking(gain, rate):
    for graphs in GRAPHS.values():
        generator, gains = scaled("uneven", rate), [0.0, gain, 0.0, 0.0]
        measured = double(graphs[:2], gains, generator)
        assert worst(measured, exact(graphs[:2], gains, generator)) < (1e-9 if rate <= 1e6 else 1e-7)


@pytest.fixture(scope="module")
def claimed_error():
    """Networks and their exact errors in 80 digits, from the benchmark."""
    script = Path(__file__).parents[3] / "benchmarks" / "claimed_error.py"
    spec = importlib.util.spec_from_file_location("claimed_error", script)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def solved_in_decimals(matrix, right):
    """What mpmath.lu_solve gives, many times faster."""
    with localcontext(prec=DIGITS):

        def decimal(x):
            sign, mantissa, exponent, _ = x._mpf_
            return (-1) ** sign * Decimal(int(mantissa)) * Decimal(2) ** exponent

        numbers = [[decimal(x) for x in row] for row in matrix.tolist()]
        found = solve(np.array(numbers, dtype=object), np.array([decimal(x) for x in right], dtype=object))
    return mpmath.matrix([mpmath.mpf(str(x)) for x in found])


@pytest.mark.parametrize(("decades", "steps", "least"), [(2, False, 12), (2, True, 12), (12, False, 12), (12, True, 8)])
def test_the_claimed_error_covers_the_true_one(claimed_error, steps, decades, least, monkeypatch):
    """Twenty networks with weights and rates over so many decades, in the steps' law at very small steps, too."""
    monkeypatch.setattr(claimed_error.mpmath, "lu_solve", solved_in_decimals)
    solved = 0
    for seed in range(20):
        try:
            experiment = claimed_error.random_experiment(seed, decades, steps=steps)
            true, claimed = claimed_error.errors(experiment, steps=steps)
        except InputError:  # the graphs do not connect the agents, or the solver refuses the equations
            continue
        assert true <= claimed <= 1e-6, seed
        solved += 1
    assert solved >= least  # of steps with 12 decades, twelve are refused


@pytest.mark.parametrize("seed", [111, 153, 265, 320, 359])
def test_the_claimed_error_covers_what_the_last_correction_leaves(seed):
    """Rates over eight decades: the correction alone, and the bound of rounding, are less than the true error."""
    random = np.random.default_rng(seed)
    rates = 10.0 ** random.uniform(-3, 5, (3, 3)) * (1.0 - np.eye(3))
    chain = rates - np.diag(rates.sum(axis=1))
    laplacians = [[[w, -w], [-w, w]] for w in 10.0 ** random.uniform(-2, 3, 3)]
    drift, noise = np.array(laplacians) + np.diag([5.0, 0.0]), np.stack([np.eye(2)] * 3)
    solver = MomentSolver(JumpSystem("continuous", drift, noise, chain, stationary_law(chain), np.eye(2)))
    found = solver.steady().sum(axis=0)
    assert worst(found, exact(laplacians, [5.0, 0.0], chain.tolist())) <= solver.report.error < 1e-11


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "noise", [{"loss": 0.9}, {"loss": 0.5, "on_loss": "hold", "broadcast": 0.1}, {"loss": 0.5, "link": 0.5, "delay": 1}]
)
def test_the_claimed_error_is_no_smaller_than_the_true_one(noise, seed):
    """Little noise in the slow direction: the same equations in 28 digits."""
    random = np.random.default_rng(seed)
    weak, weight = (10.0 ** random.uniform(-5.0, -1.0, 2)).tolist()
    noise = {**noise, "process": [1.0, weak]}
    graphs = {"a": {"path": [1, 2]}, "b": {"arcs": [[1, 2, weight]]}}
    found = predict(line_ring(2, 10.0 ** random.uniform(-5.0, 0.0), graphs=graphs, noise=noise, **TRACKING))
    system, steady = found.system, found.steady
    matrices, chain, covariances, law = (
        exactly(part) for part in (system.matrices, system.chain, system.noise, system.stationary)
    )
    size = steady.size

    def after(moments):
        moved = matrices @ moments @ matrices.swapaxes(1, 2)
        if system.losses is not None:
            into, seen = exactly(system.losses.into), exactly(system.losses.differences)
            sizes = ((seen @ moments) * seen).sum(axis=-1)[..., None]
            if system.losses.chain is not None:
                sizes = exactly(system.losses.chain) @ sizes
            moved = moved + into.swapaxes(1, 2) @ (sizes * into)
        elif system.loss_variance is not None:
            lift = exactly(system.lift)
            full = lift @ moments @ lift.T
            own = np.diagonal(full, axis1=1, axis2=2)
            squares = own[:, :, None] + own[:, None, :] - 2 * full
            spread = (exactly(system.loss_variance) * squares).sum(axis=-1)
            moved = moved + lift.T @ (spread[..., None] * lift)
        return np.tensordot(chain.T, moved, axes=1)

    basis = exactly(np.eye(size)).reshape(size, *steady.shape)
    equations = np.array([(one - after(one)).ravel() for one in basis], dtype=object).T
    right = np.tensordot(chain.T, law[:, None, None] * covariances, axes=1).ravel()
    true = solve(equations, right).reshape(steady.shape).astype(float)
    error = np.linalg.norm(steady - true, axis=(1, 2)) / np.linalg.norm(true, axis=(1, 2))
    assert error.max() <= found.emulated.solver.error <= 1e-6


@pytest.mark.parametrize("noise", [1.0, {"process": 1.0, "loss": 0.5, "on_loss": "hold"}, {"process": 1.0, "delay": 2}])
def test_what_rounding_may_change_by_more_than_a_millionth_is_refused(noise):
    graphs = {"a": {"edges": [[1, 2], [3, 4]]}, "b": {"edges": [[2, 3]]}}
    noise = noise if isinstance(noise, dict) else {"process": noise}
    assert predict(line_ring(4, 1e-5, graphs=graphs, noise=noise)).emulated.solver.error <= 1e-6
    with pytest.raises(InputError, match=r"rounding may leave a relative error of [0-9.]+e-0"):
        predict(line_ring(4, 1e-9, graphs=graphs, noise=noise))
