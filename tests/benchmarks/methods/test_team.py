"""Teams: who decides, with what in sight, and that each agent's own best is the best together."""

import math
from typing import Any

import numpy as np
import pytest
import torch as th

from benchmarks.errors import BenchmarkError
from benchmarks.evaluation.evaluate import begin_episodes, play_together
from benchmarks.methods.controls import control
from benchmarks.methods.episodes import env_arguments
from benchmarks.methods.learners import build_model, make_training_env
from benchmarks.methods.team.env import DecentralizedEnv, each_for_itself, make_env, own_masks
from benchmarks.protocol.plan import Cell, expand
from benchmarks.protocol.presets import Controls, Preset
from benchmarks.studies.insertion import Insertion
from coop_env import parallel_env
from coop_env.simulation.joint import HOLD_CHOICE, N_CHOICES, N_JOINT
from coop_env.team.agents import AGENTS
from tests.benchmarks.smoke import SMALL, parsed

SAFE: dict[str, Any] = {"reward": "progress", "mask_singularities": True}


def tiny(track: str, **hyperparameters: Any) -> Preset:
    changed = {"timesteps": 400, "hyperparameters": SMALL | hyperparameters}
    return parsed({
        **{"description": "", "seeds": [0], "evaluation": {"episodes": 2, "noise": [0.0]}},
        **{"tracks": {track: changed}, "runs": [{"methods": ["rainbow"], "tracks": [track]}]},
    })  # fmt: skip


def built(track: str, **hyperparameters: Any) -> tuple[Preset, Cell, Any]:
    preset = tiny(track, **hyperparameters)
    (cell,) = expand(preset)
    return preset, cell, build_model(preset, cell, make_training_env(preset, cell))


@pytest.mark.parametrize("sight", [False, True])
def test_joint_masks_are_what_both_agents_know(sight: bool) -> None:
    joint, pair = DecentralizedEnv(sight=sight, **SAFE), parallel_env(sight=sight, **SAFE)
    joint.reset(seed=3)
    pair.reset(seed=3)
    rng = np.random.default_rng(0)
    for _ in range(60):
        mask, own = joint.action_masks(), pair.action_masks()
        np.testing.assert_array_equal(mask, np.outer(own["delta"], own["rrs"]).ravel())
        np.testing.assert_array_equal(own_masks(mask[None])[0], [own[a] for a in AGENTS])
        action = int(rng.choice(np.flatnonzero(mask)))
        joint.step(action)
        pair.step(dict(zip(AGENTS, divmod(action, N_CHOICES), strict=True)))
        if not pair.agents:
            break


@pytest.mark.parametrize("track", ["vdn", "vdn_sight"])
def test_the_best_of_the_sum_is_each_agents_own_best(track: str) -> None:
    _, _, model = built(track)
    net, env = model.q_net, model.get_env()
    observations = th.as_tensor(env.reset())
    masks = np.stack(env.env_method("action_masks"))
    together, _ = model.predict(observations.numpy(), deterministic=True, action_masks=masks)
    own = own_masks(masks)
    for agent in range(2):
        columns = net.columns[agent]
        alone = net.networks[agent](observations[:, columns]).detach().numpy()
        best = np.where(own[:, agent], alone, -np.inf).argmax(axis=1)
        np.testing.assert_array_equal(np.stack(np.divmod(together, N_CHOICES))[agent], best)
    hidden = [i for i in range(observations.shape[1]) if i not in net.columns[0]]
    observations[:, hidden] = 0.5  # what the Delta does not see does not move it
    changed, _ = model.predict(observations.numpy(), deterministic=True, action_masks=masks)
    np.testing.assert_array_equal(changed // N_CHOICES, together // N_CHOICES)
    assert (3 if track == "vdn" else 0) == len({3, 4, 5} - set(net.columns[0]))
    joint = net.logits(observations, noisy=True)  # its quantiles are the sums of theirs
    parts = [
        each.logits(observations[:, columns], noisy=True)
        for each, columns in zip(net.networks, net.columns, strict=True)
    ]
    assert joint.shape == (4, N_JOINT, 5)
    for action in (0, 13, 48):
        delta, rrs = divmod(action, N_CHOICES)
        th.testing.assert_close(joint[:, action], parts[0][:, delta] + parts[1][:, rrs])


def test_independent_learners_have_nothing_in_common() -> None:
    _, _, model = built("independent", learning_starts=40)
    model.learn(400)
    samples = model.replay_buffer.sample(64)
    whose = samples.observations[:, -2] > 0.5
    assert whose.any()
    assert not whose.all()
    for agent, mine in enumerate((whose, ~whose)):
        model.q_net.zero_grad()
        model.q_net(samples.observations[mine], noisy=True).square().sum().backward()
        sums = [
            sum(float(p.grad.abs().sum()) for p in net.parameters() if p.grad is not None)
            for net in model.q_net.networks
        ]
        assert sums[agent] > 0.0
        assert sums[1 - agent] == 0.0


def test_rows_of_agents_act_as_in_the_batch_that_they_learned_in() -> None:
    preset, cell, model = built("shared_sight")
    env = model.get_env()
    rows = env.reset()
    masks = np.stack(env.env_method("action_masks"))
    own, _ = model.predict(rows, deterministic=True, action_masks=masks)
    single = make_env(**env_arguments(preset, cell, preset.tracks[cell.track]))
    assert isinstance(single, DecentralizedEnv)

    def policy(observations: Any, masks: Any) -> Any:
        return model.predict(observations, deterministic=True, action_masks=masks)[0]

    for i, team in enumerate(env.get_attr("unwrapped")[::2]):
        single.set_state(team.get_state())
        act = each_for_itself(policy, single)
        (action,) = act(single.observe()[None], single.action_masks()[None])
        assert divmod(int(action), N_CHOICES) == tuple(own[2 * i : 2 * i + 2])


def costs(env: Any, weight: float) -> np.ndarray:
    """Distance and angle of every joint move's end, and its potential, by making it."""
    result = np.full((N_JOINT, 3), math.inf)
    snapshot = env.get_state()
    for action in range(N_JOINT):
        env.set_state(snapshot)
        info = env.step(action)[-1]
        if not info["violation"]:
            d, a = 500.0 * info["distance"], info["alignment_error"]
            result[action] = d, a, -1.0 if info["inserted"] else d + weight * a
    env.set_state(snapshot)
    return result


@pytest.mark.parametrize("team", ["central", "in sight", "without"])
def test_the_greedy_moves_have_the_least_potential(team: str) -> None:
    arguments = {**SAFE, "team": "central"}
    if team != "central":
        arguments = {**SAFE, "team": "independent", "sight": team == "in sight"}
    (episode,) = begin_episodes(arguments, 1, 1, "validate")
    chooser = control("greedy", Controls(greedy_angle=120.0), 0)([episode])
    sight, inserted = team == "in sight", False  # without, a move may collide
    for _ in range(25):
        env = episode.env
        mask = env.action_masks()
        result = np.where(mask[:, None], costs(env, 120.0), math.inf)
        (action,) = chooser(episode.observation[None], mask[None], [0])
        delta, rrs = divmod(int(action), N_CHOICES)
        if team == "central":
            assert result[action, 2] == pytest.approx(result[:-1, 2].min(), abs=1e-9)
        else:
            alone = [N_CHOICES * delta + HOLD_CHOICE, N_CHOICES * HOLD_CHOICE + rrs]
            options = [result[HOLD_CHOICE::N_CHOICES], result[N_CHOICES * HOLD_CHOICE :]]
            for agent in range(2):
                what = 2 if sight else agent
                least = options[agent][:, what].min()
                chosen = result[alone[agent], what]
                assert chosen == pytest.approx(least, abs=1e-6) or not (sight or chosen < math.inf)
        inserted |= bool(episode.move(int(action))["inserted"])
        if episode.over or inserted:
            break


def test_a_random_team_keeps_to_its_masks() -> None:
    arguments = {**SAFE, "team": "independent", "sight": False, "max_moves": 20}
    episodes = begin_episodes(arguments, 1, 3, "validate")
    play_together(control("random", Controls(), 1)(episodes), episodes, 0.0, 0)
    assert all(episode.over for episode in episodes)
    assert all(episode.violations == episode.collisions for episode in episodes)


def test_a_sum_needs_quantiles() -> None:
    preset = tiny("vdn", v_min=-5.0, v_max=25.0)
    with pytest.raises(BenchmarkError, match="leave v_min and v_max null"):
        Insertion(preset).check(expand(preset))
