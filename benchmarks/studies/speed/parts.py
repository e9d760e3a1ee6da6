"""What one update of Rainbow consists of in torch, part by part."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from functools import partial
from typing import Any

from benchmarks.studies.speed.setting import BATCH_SIZE, seconds_of


def measure_parts(
    dqn: Any, models: dict[str, Any], rounds: int, n_calls: int = 50
) -> dict[str, dict[str, float]]:
    """
    Microseconds of a CPU core: medians over rounds, in which the parts take turns.

    Each part finds its data in the caches, as it does not within a whole update.

    :param dqn: SB3's, for its whole update
    :param models: Rainbows without ``cpu_kernels``, by name
    :param rounds: how often each part is timed
    :param n_calls: calls per timing
    """
    actions: dict[str, dict[str, Callable[[], Any]]] = {
        "SB3 DQN": {"whole update": partial(dqn.train, 1, BATCH_SIZE)}
    }
    for name, model in models.items():
        actions[name] = parts_of(model)
    found: dict[tuple[str, str], list[float]] = {}
    for round_ in range(rounds + 1):
        for name, parts in actions.items():
            for part, action in parts.items():
                cpu = seconds_of(partial(_repeat, action, n_calls)).cpu
                if round_:  # the first one warms up
                    found.setdefault((name, part), []).append(1e6 * cpu / n_calls)
    return {
        name: {part: statistics.median(found[name, part]) for part in parts}
        for name, parts in actions.items()
    }


def _repeat(action: Callable[[], Any], n_calls: int) -> None:
    for _ in range(n_calls):
        action()


def parts_of(model: Any) -> dict[str, Callable[[], Any]]:
    """One update's parts as functions; all but the first and the third follow one another."""
    from sb3_rainbow.learner.learner import as_batch

    learner, buffer = model._learner, model.replay_buffer
    samples = buffer.sample(BATCH_SIZE)
    batch = as_batch(samples, model.gamma, False)
    _, priorities = learner.update(batch)

    def replay() -> None:
        drawn = buffer.sample(BATCH_SIZE)
        buffer.update_priorities(drawn.indices, priorities.numpy())

    def noise() -> None:
        learner.q_net.reset_noise()
        learner.q_net_target.reset_noise()

    return {
        "whole update": partial(model.train, 1, BATCH_SIZE),
        "loss and gradient": partial(learner.gradient, batch),
        "their matrix products alone": matrix_products(model.q_net),
        "optimizer": model.policy.optimizer.step,
        "replay": replay,
        "noise": noise,
        "target network": partial(learner.move_target, model.tau),
    }


def matrix_products(q_net: Any) -> Callable[[], None]:
    """
    The products of an update: three passes forward, and one back by weights and by inputs.

    The head is evaluated for all actions, as torch does it.
    """
    import torch as th

    sizes = [(layer.in_features, layer.out_features) for layer in q_net.layers]
    tensors = [
        (th.randn(BATCH_SIZE, n_in), th.randn(n_out, n_in), th.randn(BATCH_SIZE, n_out))
        for n_in, n_out in sizes
    ]

    def products() -> None:
        with th.no_grad():
            for i, (inputs, weight, slope) in enumerate(tensors):
                for _ in range(3):
                    th.mm(inputs, weight.t())
                th.mm(slope.t(), inputs)
                if i:
                    th.mm(slope, weight)

    return products
