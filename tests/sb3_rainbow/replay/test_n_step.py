"""n-step replay against a loop over recorded episodes, written without looking at the buffer."""

import pickle
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_rainbow import PrioritizedReplayBuffer

GAMMA = 0.9
HALVES = VecNormalize(make_vec_env("CartPole-v1"), norm_obs=False)  # rewards
HALVES.ret_rms.var = np.array(4.0)


@dataclass
class Step:
    """One step of one env."""

    obs: float
    next_obs: float
    action: int
    reward: float
    terminated: bool
    truncated: bool
    mask: np.ndarray


class World:
    """Envs whose episodes end at random, and whose every observation is a number of its own."""

    def __init__(self, n_envs: int, seed: int, p_end: float = 0.2) -> None:
        self.rng, self.p_end, self._counter = np.random.default_rng(seed), p_end, 0
        self.steps: list[list[Step]] = [[] for _ in range(n_envs)]
        self.current = [self.fresh() for _ in range(n_envs)]

    def fresh(self) -> float:
        self._counter += 1
        return float(self._counter)

    def step(self) -> list[Step]:
        for env, steps in enumerate(self.steps):
            ends = self.rng.random() < self.p_end
            truncated = bool(ends and self.rng.random() < 0.5)
            mask = self.rng.random(5) < 0.5
            mask[self.rng.integers(5)] = True
            obs, next_obs = self.current[env], self.fresh()
            action, reward = int(self.rng.integers(5)), float(self.rng.normal())
            terminated = ends and not truncated
            steps.append(Step(obs, next_obs, action, reward, terminated, truncated, mask))
            self.current[env] = self.fresh() if ends else next_obs
        return [steps[-1] for steps in self.steps]

    def reset(self) -> None:
        """Leave all episodes in the middle."""
        for env, steps in enumerate(self.steps):
            steps[-1].truncated = not steps[-1].terminated
            self.current[env] = self.fresh()


def expected_samples(world: World, capacity: int, n_steps: int) -> dict[float, tuple[Any, ...]]:
    """By first observation: what every transition that is due must look like."""
    result = {}
    for steps in world.steps:
        oldest = max(0, len(steps) - capacity)
        for start in range(oldest, len(steps)):
            window = []
            for step in steps[start : start + n_steps]:
                window.append(step)
                if step.terminated or step.truncated:
                    break
            last = window[-1]
            if len(window) < n_steps and not (last.terminated or last.truncated):
                continue
            n_step_return = sum(GAMMA**k * step.reward for k, step in enumerate(window))
            ahead = (last.terminated, last.next_obs, last.mask)
            result[window[0].obs] = (window[0].action, n_step_return, GAMMA ** len(window), *ahead)
    return result


def encode(values: list[float], kind: str) -> Any:
    column = np.array(values, dtype=np.float32)
    if kind == "dict":
        return {"a": np.stack([column, -column], 1), "b": (column % 251)[:, None].astype(np.uint8)}
    if kind == "discrete":
        return column.astype(np.int64)
    if kind == "image":
        low, high = column % 256, column // 256
        return np.stack([low, high], 1).astype(np.uint8).reshape(-1, 2, 1, 1)
    return np.stack([column, -column], 1)


def decode(obs: Any, kind: str) -> np.ndarray:
    if kind == "dict":
        np.testing.assert_array_equal(obs["a"][:, 0] % 251, obs["b"][:, 0])
        return obs["a"][:, 0].numpy()
    if kind == "image":
        return obs[:, 0, 0, 0].numpy() + 256.0 * obs[:, 1, 0, 0].numpy()
    return obs[:, 0].numpy().astype(float)


SPACES: dict[str, spaces.Space] = {
    "box": spaces.Box(-np.inf, np.inf, (2,), np.float32),
    "box64": spaces.Box(-np.inf, np.inf, (2,), np.float64),
    "discrete": spaces.Discrete(100_000),
    "image": spaces.Box(0, 255, (2, 1, 1), np.uint8),
    "dict": spaces.Dict(
        a=spaces.Box(-np.inf, np.inf, (2,), np.float32), b=spaces.Box(0, 255, (1,), np.uint8)
    ),
}


def make_buffer(kind: str, n_envs: int, capacity: int, n_steps: int) -> PrioritizedReplayBuffer:
    given: dict[str, Any] = {"n_envs": n_envs, "n_steps": n_steps, "gamma": GAMMA}
    size, actions = capacity * n_envs, spaces.Discrete(5)
    return PrioritizedReplayBuffer(size, SPACES[kind], actions, device="cpu", **given)


def add(buffer: PrioritizedReplayBuffer, row: list[Step], kind: str = "box") -> None:
    buffer.add(
        encode([step.obs for step in row], kind),
        encode([step.next_obs for step in row], kind),
        np.array([step.action for step in row]),
        np.array([step.reward for step in row]),
        np.array([step.terminated or step.truncated for step in row]),
        [{"TimeLimit.truncated": step.truncated} for step in row],
        np.array([step.mask for step in row]),
    )


def check(buffer: PrioritizedReplayBuffer, world: World, kind: str = "box") -> None:
    """Every transition that is due can be drawn, no other, and each is right in all fields."""
    expected = expected_samples(world, buffer.buffer_size, buffer.n_steps)
    leaves = np.flatnonzero(buffer.tree.leaves)
    assert leaves.size == len(expected)
    if not leaves.size:
        return
    samples: Any = buffer._get_samples(leaves)
    found = decode(samples.observations, kind)
    assert set(found) == set(expected)
    columns = zip(*(expected[obs] for obs in found), strict=True)
    actions, returns, discounts, dones, next_obs, masks = map(np.array, columns)
    np.testing.assert_array_equal(samples.actions[:, 0], actions)
    np.testing.assert_allclose(samples.rewards[:, 0], returns, rtol=0, atol=1e-5)
    halves: Any = buffer._get_samples(leaves, HALVES).rewards
    np.testing.assert_allclose(halves[:, 0], returns / 2, rtol=0, atol=1e-5)
    np.testing.assert_allclose(samples.discounts[:, 0], discounts, rtol=1e-6)
    np.testing.assert_array_equal(samples.dones[:, 0], dones)
    np.testing.assert_array_equal(decode(samples.next_observations, kind), next_obs)
    np.testing.assert_array_equal(samples.next_action_masks, masks)


# At the ends, endless episodes and those of one step
@pytest.mark.parametrize("p_end", [0.2, 0.0, 1.0])
@pytest.mark.parametrize(("n_envs", "n_steps"), [(1, 1), (1, 3), (1, 5), (3, 1), (3, 3), (3, 5)])
def test_after_every_step_the_buffer_holds_what_the_loop_says(
    n_envs: int, n_steps: int, p_end: float
) -> None:
    world = World(n_envs, 10 * n_envs + n_steps, p_end)
    buffer = make_buffer("box", n_envs, 11, n_steps)
    for _ in range(60):
        add(buffer, world.step())
        check(buffer, world)
    assert buffer.full


@pytest.mark.parametrize("kind", list(SPACES))
def test_every_kind_of_observation(kind: str) -> None:
    world = World(2, seed=5)
    buffer = make_buffer(kind, 2, 17, 3)
    for _ in range(50):
        add(buffer, world.step(), kind)
    check(buffer, world, kind)


def test_a_reset_without_done_cuts_the_windows_there() -> None:
    world = World(2, seed=3, p_end=0.1)
    buffer = make_buffer("box", 2, 20, 4)
    for i in range(60):
        if i % 7 == 6:
            world.reset()
        add(buffer, world.step())
        check(buffer, world)


def test_pickling_keeps_open_windows_and_samples() -> None:
    world = World(2, seed=8)
    buffer = make_buffer("box", 2, 20, 3)
    for step in range(55):
        if step in (7, 40):  # before it is full, and after
            buffer = pickle.loads(pickle.dumps(buffer))
        check(buffer, world)
        add(buffer, world.step())
    check(buffer, world)


def test_truncations_count_as_ends_where_timeouts_are_not_handled() -> None:
    buffer = PrioritizedReplayBuffer(
        10, SPACES["box"], spaces.Discrete(5), device="cpu", handle_timeout_termination=False
    )
    add(buffer, [Step(1.0, 2.0, 0, 1.0, False, True, np.ones(5, bool))])
    assert buffer.sample(1).dones.item() == 1.0


def test_masks_take_memory_as_they_are_stored() -> None:
    process = pytest.importorskip("psutil").Process()
    space = spaces.Box(-1, 1, (2,), np.float32)
    buffer = PrioritizedReplayBuffer(1_000_000, space, spaces.Discrete(200), device="cpu")
    obs, one, no = np.zeros((1, 2), np.float32), np.ones(1), np.zeros(1, bool)
    buffer.add(obs, obs, one, one, no, [{}])  # without masks: all is allowed
    before = process.memory_info().rss
    buffer.add(obs, obs, one, one, no, [{}], np.eye(200, dtype=bool)[:1])
    assert process.memory_info().rss - before < 50e6
    masks: Any = buffer._get_samples(np.arange(2)).next_action_masks
    assert masks.sum(dim=1).tolist() == [200, 1]
