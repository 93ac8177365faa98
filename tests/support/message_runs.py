"""Runs simulated message by message, in a simulator of its own: what every agent heard, used and logged.

It shares the experiment's document and the phases of the agents with the software, and no random number. Timers may be
late and messages slow; by default nobody is late, and messages arrive at once.
"""

import math

import numpy as np
import scipy.linalg

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.model.run import Completeness, Run
from msg_analysis.model.step_model import phases
from msg_analysis.twin.simulate import new_record


def lost_messages(random, probability, burst, count):
    """(count,) of one link: independent, or a Gilbert channel from its stationary law."""
    if burst is None or not probability:
        return random.random(count) < probability
    found = np.empty(count, dtype=bool)
    found[0] = random.random() < probability
    fails = probability / (burst * (1 - probability))
    for s, draw in enumerate(random.random(count - 1), start=1):
        found[s] = draw >= 1 / burst if found[s - 1] else draw < fails
    return found


def message_run(experiment: Experiment, seed: int, *, actual=None, late=0.0, latency=0.0) -> Run:
    """A run of an experiment, by the law of ``actual`` if that is another one; start zero or given."""
    # ``late`` and ``latency``: mean of exponential times, in steps, by which steps are late and messages under way.
    law, random = actual or experiment, np.random.default_rng(seed)
    record = new_record(experiment)
    m, steps, dt, replicas = law.agents, law.steps, law.step_length, law.run.replicas
    noise, real_time = law.noise, law.run.pace == "realtime"
    holds, delay = noise.holds, noise.delay
    gains = law.leader_gains
    laplacians = [np.diag(g.adjacency.sum(axis=1)) - g.adjacency for g in law.graph_list]
    weights = np.eye(m) - dt * (np.stack(laplacians) + np.diag(gains))
    senders = [[[j for j in range(m) if j != i and w[i, j]] for i in range(m)] for w in weights]
    most = max(len(one) for graph in senders for one in graph)

    transition = scipy.linalg.expm(dt * law.chain.matrix)
    shares = np.linalg.matrix_power(transition, 4096)[0]
    up_to = transition.cumsum(axis=1)
    modes = np.empty(steps, dtype=np.int64)
    mode = random.choice(len(shares), p=shares)
    for k in range(steps):
        modes[k] = mode
        mode = int(up_to[mode].searchsorted(random.random() * up_to[mode, -1], side="right"))

    links = sorted({(i, j) for graph in senders for i in range(m) for j in graph[i]})
    lost = {link: lost_messages(random, law.loss[link], noise.burst, steps + 1) for link in links}
    if noise.holds:
        for link in links:
            lost[link][0] = False
    drawn = {link: noise.link * random.standard_normal((steps + 1, replicas)) for link in links}
    process = math.sqrt(dt) * random.standard_normal((steps, m, replicas))
    process = np.einsum("ij,kjr->kir", law.noise_gain[0], process)
    air = noise.broadcast * random.standard_normal((steps + 1, m, replicas))

    due = np.repeat(np.arange(1.0, steps + 1)[:, None], m, axis=1)
    if real_time:
        due += phases(law) - 1.0 + late * random.exponential(size=(steps, m))
        due = np.maximum.accumulate(due + 1e-9 * np.arange(1, steps + 1)[:, None], axis=0)
    made = np.zeros((steps + 1, m), dtype=np.int64)
    made[1:] = np.rint(1e9 * dt * due).astype(np.int64)
    # Messages of a link keep their order.
    arrives = {}
    for link in links:
        under_way = np.rint(1e9 * dt * latency * random.exponential(size=steps + 1))
        arrives[link] = np.maximum.accumulate(made[:, link[1]] + under_way).tolist()

    used = np.full((steps, m, most), -1, dtype=np.int64)
    gone = np.zeros((steps, m, most), dtype=bool)
    newest = dict.fromkeys(links, 0)
    # For the loop, which reads them one by one: as plain numbers, rows of replicas where there are several.
    path, rows, is_lost = modes.tolist(), weights.tolist(), {link: one.tolist() for link, one in lost.items()}
    process, air, at = _numbers(process), _numbers(air), made.T.tolist()
    drawn = {link: _numbers(one) for link, one in drawn.items()}
    states = [[None] * m for _ in range(steps + 1)]
    published = [[None] * m for _ in range(steps + 1)]
    states[0] = _numbers(np.asarray(record.start))
    published[0] = [x + added for x, added in zip(states[0], air[0], strict=True)]
    order = np.lexsort((np.tile(np.arange(m), steps), np.repeat(np.arange(steps), m), due.ravel()))
    gives = [(law.reference * (1.0 - w.sum(axis=1))).tolist() for w in weights]  # the reference to each agent
    for k, i in np.column_stack(np.unravel_index(order, (steps, m))).tolist():
        mode, own = path[k], states[k][i]
        w = rows[mode][i]
        total = own * w[i] + gives[mode][i]
        for d, j in enumerate(senders[mode][i]):
            n = k
            if real_time:
                n, now, comes, sent = newest[i, j], at[i][k + 1], arrives[i, j], at[j]
                while n < steps and sent[n + 1] < now and comes[n + 1] <= now:
                    n += 1
                newest[i, j] = n
            s = max(0, n - delay)
            gone[k, i, d] = is_lost[i, j][s]
            if holds:
                while is_lost[i, j][s]:
                    s -= 1
            elif is_lost[i, j][s]:
                s = -1
            used[k, i, d] = s
            total = total + w[j] * (own if s < 0 else published[s][j] + drawn[i, j][s])
        states[k + 1][i] = following = total + process[k][i]
        published[k + 1][i] = following + air[k + 1][i]
    states, published = (np.array(each).reshape(steps + 1, m, replicas) for each in (states, published))
    whole = Completeness(states.shape[0] * m, states.shape[0] * m, 0)
    return Run(
        record,
        states,
        modes,
        whole,
        agent_modes=np.concatenate([np.full((1, m), -1), np.repeat(modes[:, None], m, axis=1)]) if real_time else None,
        published=published if noise.broadcast else None,
        lost=gone if noise.loss.any and not real_time else None,
        used=used if real_time or noise.delay or noise.holds else None,
        made=made if real_time else None,
    )


def _numbers(values):
    """Nested lists (...) of an array (..., R): of numbers, or of the rows of the replicas where these are several."""
    if values.shape[-1] == 1:
        return values[..., 0].tolist()
    return list(values) if values.ndim == 2 else [_numbers(each) for each in values]
