"""The corrections of docs/errata.md, each computed: what the paper says, the numbers, and whether the correction holds.

    python benchmarks/errata.py          all of them
    python benchmarks/errata.py 6        one

Everything is in the full Kronecker form of the paper, a few lines of numpy that share nothing with the package.
Exit code 1 if a number does not bear out its correction. Takes about a second.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg

from msg_analysis.common.arrays import FloatArray

LINE = [(1, 2), (2, 3), (3, 4), (4, 5)]
RING = [*LINE, (1, 5)]


class Finding(NamedTuple):
    """What one correction comes to."""

    claim: str
    numbers: list[str]
    verdict: str
    holds: bool


def laplacian(edges: Sequence[tuple[int, int]], m: int) -> FloatArray:
    result = np.zeros((m, m))
    for i, j in edges:
        difference = np.zeros(m)
        difference[i - 1], difference[j - 1] = 1.0, -1.0
        result += np.outer(difference, difference)
    return result


def kron(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.kron(a, b), dtype=float)


def kron_sum(z: FloatArray) -> FloatArray:
    return kron(z, np.eye(len(z))) + kron(np.eye(len(z)), z)


def blocks(matrices: Sequence[FloatArray]) -> FloatArray:
    return np.asarray(scipy.linalg.block_diag(*matrices), dtype=float)


def projector(m: int) -> FloatArray:
    return np.asarray(np.eye(m) - 1.0 / m)


def pinv(matrix: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.pinv(matrix, rcond=1e-11))


def nullity(matrix: FloatArray) -> int:
    values = np.linalg.svd(matrix, compute_uv=False)
    return int(np.count_nonzero(values < 1e-10 * values[0]))


def generator(pi: FloatArray, beta: float) -> FloatArray:
    """Two modes with stationary law pi and q12 + q21 = beta."""
    return beta * np.array([[-pi[1], pi[1]], [pi[0], -pi[0]]])


def continuous(graphs: Sequence[FloatArray], pi: FloatArray, gamma: FloatArray, q: FloatArray) -> FloatArray:
    """(m,) node errors of consensus by the paper's proposition."""
    m = len(q)
    v = projector(m)
    matrix = blocks([kron_sum(v @ z @ v) for z in graphs]) - kron(gamma.T, kron(v, v))
    c = pinv(matrix) @ np.kron(pi, (v @ q @ v).ravel())
    return np.diag(c.reshape(-1, m, m).sum(axis=0)).copy()


def static(graphs: Sequence[FloatArray], pi: FloatArray, q: FloatArray) -> FloatArray:
    v = projector(len(q))
    held = [pinv(kron_sum(v @ z @ v)) @ (v @ q @ v).ravel() for z in graphs]
    return np.asarray(sum(p * np.diag(c.reshape(q.shape)) for p, c in zip(pi, held, strict=True)))


class Pair(NamedTuple):
    """What the two-topology formula is made of, as the paper defines it."""

    inverses: list[FloatArray]
    omega: FloatArray
    seen: FloatArray
    apart: FloatArray
    static: float


def two_topology(graphs: Sequence[FloatArray], pi: FloatArray, q: FloatArray) -> Pair:
    m = len(q)
    v = projector(m)
    both, h = kron(v, v), np.eye(m).ravel()
    one, two = [pinv(kron_sum(v @ z @ v)) for z in graphs]
    noise = (v @ q @ v).ravel()
    return Pair(
        [one, two],
        both @ (pi[1] * one + pi[0] * two),
        h @ (two - one),
        both @ (two - one) @ noise,
        float(h @ (pi[0] * one + pi[1] * two) @ noise),
    )


def nullities() -> Finding:
    half = np.array([0.5, 0.5])
    lines, holds = [], True
    cases = {
        "line and ring, 5 agents": ([LINE, RING], 2),
        "edge 1-2 and edges 2-3, 3-4 (disconnected), 4 agents": ([[(1, 2)], [(2, 3), (3, 4)]], 8),
    }
    for title, (graphs, expected) in cases.items():
        m = max(max(edge) for edges in graphs for edge in edges)
        v = projector(m)
        z = [v @ laplacian(edges, m) @ v for edges in graphs]
        gamma = generator(half, 1.0)
        first = blocks(z) - kron(gamma.T, v)
        second = blocks([kron_sum(x) for x in z]) - kron(gamma.T, kron(v, v))
        found = nullity(first), nullity(second)
        lines.append(f"{title}: nullity of Nbar_c {found[0]}, of Mbar_c {found[1]}")
        holds &= found == (2, expected)
    return Finding(
        "Nbar_c and Mbar_c have exactly one eigenvalue at 0.",
        lines,
        "n of them: one for each graph; Mbar_c has 2 (components - 1) more for every disconnected graph.",
        holds,
    )


def any_rate() -> Finding:
    graphs, pi, q = [laplacian(LINE, 5), laplacian(RING, 5)], np.array([0.3, 0.7]), np.eye(5)
    pair = two_topology(graphs, pi, q)
    lines, worst = [], 0.0
    for beta in (1e-3, 1.0, 1e3, 1e5):
        inner = np.linalg.solve(np.eye(25) + beta * pair.omega, pair.apart)
        closed = pair.static - beta * pi[0] * pi[1] * float(pair.seen @ inner)
        reference = float(continuous(graphs, pi, generator(pi, beta), q).sum())
        worst = max(worst, abs(closed / reference - 1.0))
        lines.append(f"beta = {beta:g}: closed form {closed:.12f}, pseudo-inverse {reference:.12f}")
    symmetric = 0.5 * (pair.omega + pair.omega.T)
    least = float(np.linalg.eigvalsh(symmetric).min())
    lines.append(f"least eigenvalue of Omega: {least:.1e} (0 on the consensus subspace)")
    return Finding(
        "The two-topology formula needs beta sufficiently small.",
        lines,
        "It holds for every beta > 0: Omega has no negative eigenvalue, so I + beta Omega is always regular.",
        worst < 1e-8 and least > -1e-12,
    )


def proof_of_two_topology() -> Finding:
    graphs, pi, q = [laplacian(LINE, 5), laplacian(RING, 5)], np.array([0.3, 0.7]), np.diag([1.0, 2.0, 0.5, 1.0, 3.0])
    v = projector(5)
    both = kron(v, v)
    pair = two_topology(graphs, pi, q)
    inverse = blocks(pair.inverses)
    second = kron(np.array([[-pi[1], pi[0]], [pi[1], -pi[0]]]), both)
    h, t = np.tile(np.eye(5).ravel(), 2), np.kron(pi, (v @ q @ v).ravel())
    beta, lines, holds = 0.7, [], True
    for p in (1, 2, 3):
        row = h @ np.linalg.matrix_power(inverse @ second, p)
        inner = pair.seen @ np.linalg.matrix_power(pair.omega, p - 1) @ both
        signed = (-1.0) ** p * np.concatenate([-pi[1] * inner, pi[0] * inner])
        term = beta**p * float(row @ inverse @ t)
        alpha = beta * pi[0] * pi[1]
        printed = (-1.0) ** (p - 1) * alpha * float(pair.seen @ np.linalg.matrix_power(pair.omega, p - 1) @ pair.apart)
        right = -(beta ** (p - 1)) * printed
        holds &= bool(np.allclose(row, signed, atol=1e-12)) and abs(term - right) < 1e-12
        lines.append(f"p = {p}: term {term:+.9f}, printed {printed:+.9f}, corrected {right:+.9f}")
    matrix = blocks([kron_sum(v @ z @ v) for z in graphs]) - kron(generator(pi, beta).T, both)
    product = matrix @ pinv(matrix)
    printed_projection = np.eye(50) - 1.0 / 50.0
    right_projection = kron(np.eye(2), np.eye(25) - 1.0 / 25.0)
    wrong, good = (float(np.abs(product - x).max()) for x in (printed_projection, right_projection))
    lines.append(f"Mbar_c Mbar_c^+ is off the printed Pi by {wrong:.2e}, off I_n (x) (I - 1 1^T / m^2) by {good:.1e}")
    holds &= good < 1e-10 < wrong
    return Finding(
        "Proof of the two-topology formula: signs (-1)^(p-1), a block diagonal matrix, Pi = I - 1 1^T / (n m^2).",
        lines,
        "The sign is (-1)^p, beta^p comes with the p-th term, the matrix is a block row, Pi projects in every mode.",
        holds,
    )


def discrete_two_topology() -> Finding:
    pi, beta, m = np.array([0.3, 0.7]), 0.6, 5
    v = projector(m)
    both = kron(v, v)
    w = [v @ np.asarray(scipy.linalg.expm(-laplacian(edges, m))) @ v for edges in (LINE, RING)]
    second = blocks([kron(x, x) for x in w])
    p = np.eye(2) + generator(pi, beta)
    exact = np.eye(2 * m * m) - kron(p.T, both) @ second
    first = np.eye(2 * m * m) - second
    off = {}
    for name, r in {
        "as printed": np.array([[-pi[1], pi[1]], [pi[0], -pi[0]]]),
        "transposed": np.array([[-pi[1], pi[0]], [pi[1], -pi[0]]]),
    }.items():
        off[name] = float(np.abs(first - beta * kron(r, both) @ second - exact).max())
    return Finding(
        "Discrete remark: I - Abar_c = R_1 - beta R_2 with R_2 from [[-pi_2, pi_2], [pi_1, -pi_1]].",
        [f"R_2 {name}: R_1 - beta R_2 is off I - Abar_c by {value:.1e}" for name, value in off.items()],
        "R_2 must carry the transpose, [[-pi_2, pi_1], [pi_2, -pi_1]], as in continuous time.",
        off["transposed"] < 1e-12 < off["as printed"],
    )


def discrete_appendix() -> Finding:
    pi, m = np.array([0.3, 0.7]), 5
    p = np.eye(2) + generator(pi, 0.6)
    v = projector(m)
    w = [v @ np.asarray(scipy.linalg.expm(-laplacian(edges, m))) @ v for edges in (LINE, RING)]
    f = 2.0 * np.eye(m)
    mean = np.multiply.outer(pi, v @ np.arange(m))
    moments = np.einsum("i,ab->iab", pi, np.outer(v @ np.arange(m), v @ np.arange(m)))
    # One step, from its meaning: for every graph now, what the agents do, and where the chain goes.
    after_mean, after = np.zeros_like(mean), np.zeros_like(moments)
    for j, i in itertools.product(range(2), range(2)):
        after_mean[i] += p[j, i] * w[j] @ mean[j]
        after[i] += p[j, i] * (w[j] @ moments[j] @ w[j].T + pi[j] * v @ f @ f.T @ v)
    h = kron(p.T, np.eye(m)) @ blocks(w)
    product = kron(p.T, np.eye(m * m)) @ blocks([kron(x, x) for x in w])
    summed = kron(p.T, np.eye(m * m)) @ blocks([kron_sum(x) for x in w])

    def off(matrix: FloatArray, noise: FloatArray) -> float:
        step = matrix @ moments.ravel() + np.kron(pi, (v @ noise @ v).ravel())
        return float(np.abs(step - after.ravel()).max())

    mean_off = {sign: float(np.abs(sign * h @ mean.ravel() - after_mean.ravel()).max()) for sign in (-1, 1)}
    radius = float(np.abs(np.linalg.eigvals(product)).max())
    numbers = [
        f"mean recursion with the minus is off by {mean_off[-1]:.2e}, without it by {mean_off[1]:.1e}",
        f"Abar_c with sums is off by {off(summed, f @ f.T):.2e}, with products by {off(product, f @ f.T):.1e}",
        f"F = 2 I read as the covariance is off by {off(product, f):.2e}, as the gain by {off(product, f @ f.T):.1e}",
        f"spectral radius of Abar_c: {radius:.6f}; nullity of I - Abar_c: {nullity(np.eye(len(product)) - product)}",
    ]
    holds = max(mean_off[1], off(product, f @ f.T)) < 1e-12 < min(mean_off[-1], off(summed, f @ f.T), off(product, f))
    return Finding(
        "Discrete appendix: nu(k+1) = -Hbar_c nu(k), Abar_c from B_i (+) B_i, F a covariance, a pseudo-inverse.",
        numbers,
        "No minus; Kronecker products; F is the gain and Q = F F^T; the inverse exists.",
        holds and radius < 1.0,
    )


def switching_hurts() -> Finding:
    graphs = [laplacian([(1, 4), (1, 5), (2, 3), (3, 4)], 5), laplacian([(1, 3), (2, 4), (2, 5), (3, 4)], 5)]
    pi, q = np.array([0.5, 0.5]), np.diag([0.001, 0.001, 0.001, 1.0, 0.001])
    error, baseline = continuous(graphs, pi, generator(pi, 1.0), q).sum(), static(graphs, pi, q).sum()
    return Finding(
        "Switching never hurts, for any reasonable F.",
        [f"edges 14, 15, 23, 34 and 13, 24, 25, 34, both rates 0.5: E = {error:.6f}, static {baseline:.6f}"],
        "It can, where agents have unequal noise. With Q = q I and undirected graphs E <= E_static holds.",
        bool(error > baseline + 1e-4),
    )


def faster_is_not_always_better() -> Finding:
    graphs = [laplacian([(1, 4), (1, 5), (2, 3), (3, 4)], 5), laplacian([(1, 3), (2, 4), (2, 5), (3, 4)], 5)]
    pi, q = np.array([0.5, 0.5]), np.diag([0.001, 0.001, 0.001, 1.0, 0.001])
    rates = (0.01, 0.2, 1.0, 2.0, 10.0)
    unequal = [float(continuous(graphs, pi, generator(pi, beta), q).sum()) for beta in rates]
    equal = [float(continuous(graphs, pi, generator(pi, beta), np.eye(5)).sum()) for beta in rates]
    numbers = [
        f"beta = {beta:g}: E = {a:.6f} with unequal noise, {b:.6f} with Q = I"
        for beta, a, b in zip(rates, unequal, equal, strict=True)
    ]
    return Finding(
        "alpha grows with the rates and scales a term that helps, so more frequent switching gives lower error.",
        numbers,
        "(I + beta Omega)^-1 shrinks meanwhile, so alpha alone shows nothing. pi_1 pi_2 (I / beta + Omega)^-1 grows "
        "with beta, which proves it for Q = I; with unequal noise E can rise first.",
        bool(np.all(np.diff(equal) < 0)) and unequal[2] > unequal[0] > unequal[-1],
    )


def single_nodes() -> Finding:
    graphs = [laplacian([(1, 4), (1, 5), (2, 3), (2, 4)], 5), laplacian([(1, 2), (1, 4), (3, 5), (4, 5)], 5)]
    pi, q = np.array([0.5, 0.5]), np.eye(5)
    error, baseline = continuous(graphs, pi, generator(pi, 1.0), q), static(graphs, pi, q)
    numbers = [f"agent {i}: {a:.6f}, static {b:.6f}" for i, (a, b) in enumerate(zip(error, baseline, strict=True), 1)]
    numbers.append(f"system: {error.sum():.6f}, static {baseline.sum():.6f}")
    return Finding(
        "Switching cannot hurt for F = I; an equivalent equation holds for node errors.",
        ["edges 14, 15, 23, 24 and 12, 14, 35, 45, both rates 0.5", *numbers],
        "True of the system error. A single agent can get worse even with Q = I: here agent 4.",
        bool(error[3] > baseline[3] + 1e-3 and error.sum() < baseline.sum()),
    )


def middle_of_the_line() -> Finding:
    pi, q = np.array([0.5, 0.5]), np.eye(5)
    numbers = []
    certainties = []
    for title, edges in {"line": LINE, "ring": RING, "line and edge 1-4": [*LINE, (1, 4)]}.items():
        certainties.append(1.0 / float(static([laplacian(edges, 5)], np.ones(1), q)[2]))
        numbers.append(f"{title}: certainty of agent 3 is {certainties[-1]:.9f}")
    switching = [
        1.0 / float(continuous([laplacian(LINE, 5), laplacian(RING, 5)], pi, generator(pi, beta), q)[2])
        for beta in (0.1, 1.0, 10.0)
    ]
    numbers.append("line and ring, beta = 0.1, 1, 10: " + ", ".join(f"{x:.9f}" for x in switching))
    return Finding(
        "Agent 3 of the line/ring example shows that only shortest paths affect success.",
        numbers,
        "Its certainty is 5 in both graphs by symmetry: the edge 1-5 joins mirror images. The edge 1-4 leaves all "
        "distances from agent 3 as they are, too, and does change its certainty.",
        bool(np.allclose([*certainties[:2], *switching], 5.0, atol=1e-9)) and abs(certainties[2] - 5.0) > 0.1,
    )


def leaders_of_a_static_graph() -> Finding:
    line = laplacian(LINE, 5)

    def error(leaders: Sequence[int]) -> float:
        follow = [i for i in range(5) if i + 1 not in leaders]
        return 0.5 * float(np.trace(np.linalg.inv(line[np.ix_(follow, follow)])))

    certainty = 1.0 / static([line], np.ones(1), np.eye(5))
    numbers = ["certainty of agents 1 to 5 on the line: " + ", ".join(f"{x:.4f}" for x in certainty)]
    ranked = sorted((error(pair), pair) for pair in itertools.combinations(range(1, 6), 2))
    numbers += [f"leaders {pair}: E = {value:.6f}" for value, pair in ranked]
    single = min(range(1, 6), key=lambda i: error([i]))
    numbers.insert(1, f"best single leader: {single}, the most certain agent")
    return Finding(
        "On a static graph the agents with the greatest combined certainty are always the best set of leaders.",
        numbers,
        "True of one leader only. On the line the two most certain agents, 3 and 2 (or 4), are among the worst pairs.",
        single == int(np.argmax(certainty)) + 1 and error((2, 3)) > ranked[5][0],
    )


ERRATA: list[Callable[[], Finding]] = [
    nullities,
    any_rate,
    proof_of_two_topology,
    discrete_two_topology,
    discrete_appendix,
    switching_hurts,
    faster_is_not_always_better,
    single_nodes,
    middle_of_the_line,
    leaders_of_a_static_graph,
]


def main() -> int:
    parser = argparse.ArgumentParser(description="Compute the corrections of docs/errata.md.")
    parser.add_argument("number", nargs="?", type=int, choices=range(1, len(ERRATA) + 1), help="default: all")
    wanted = parser.parse_args().number
    held = True
    for number, check in enumerate(ERRATA, start=1):
        if wanted in (None, number):
            finding = check()
            print(f"{number}. The paper: {finding.claim}")
            print("".join(f"     {line}\n" for line in finding.numbers), end="")
            print(f"   {'Corrected' if finding.holds else 'NOT BORNE OUT'}: {finding.verdict}\n")
            held &= finding.holds
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main())
