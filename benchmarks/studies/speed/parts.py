"""What one update of Rainbow consists of in torch, part by part."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from benchmarks.studies.speed.report import in_turns
from benchmarks.studies.speed.setting import BATCH_SIZE


def measure_parts(
    dqn: Any, models: dict[str, Any], rounds: int, n_calls: int = 50
) -> dict[str, dict[str, float]]:
    """Microseconds of a CPU core: medians over rounds, in which the parts take turns.

    Each part finds its data in the caches, as it does not within a whole update.

    Args:
        dqn: SB3's, for its whole update.
        models: Rainbows without ``cpu_kernels``, by name.
        rounds: how often each part is timed.
        n_calls: calls per timing.
    """
    actions = {name: parts_of(model) for name, model in models.items()}
    actions = {"SB3 DQN": {"whole update": partial(dqn.train, 1, BATCH_SIZE)}, **actions}
    flat = {(name, part): action for name in actions for part, action in actions[name].items()}
    found = in_turns(flat, rounds, n_calls, unit=1e-6)
    return {name: {part: found[name, part] for part in parts} for name, parts in actions.items()}


def parts_of(model: Any) -> dict[str, Callable[[], Any]]:
    """One update's parts as functions; all but the first and the third follow one another."""
    from sb3_rainbow.learner.learner import as_batch

    learner, buffer = model._learner, model.replay_buffer
    batch = as_batch(buffer.sample(BATCH_SIZE), model.gamma, False)
    _, priorities = learner.update(batch)

    def replay() -> None:
        buffer.update_priorities(buffer.sample(BATCH_SIZE).indices, priorities.numpy())

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
    """An update's products for all actions: three forward, one back by weights and by inputs."""
    import torch as th

    sizes = [(layer.in_features, layer.out_features) for layer in q_net.layers]
    tensors = [
        (th.randn(BATCH_SIZE, n_in), th.randn(n_out, n_in), th.randn(BATCH_SIZE, n_out))
        for n_in, n_out in sizes
    ]

    @th.no_grad()
    def products() -> None:
        for i, (inputs, weight, slope) in enumerate(tensors):
            for _ in range(3):
                th.mm(inputs, weight.t())
            th.mm(slope.t(), inputs)
            if i:
                th.mm(slope, weight)

    return products
