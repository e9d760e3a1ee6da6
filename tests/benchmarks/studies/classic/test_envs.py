"""The tasks of the public presets: Gymnasium's and SB3's checks, seeds, masks, closed form."""

import sys
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env as gymnasium_check
from stable_baselines3.common.env_checker import check_env as sb3_check

from benchmarks.errors import BenchmarkError
from benchmarks.studies.classic.envs import (
    IdentityEnv,
    MaskedIdentityEnv,
    MinAtarEnv,
    NowAndThenRandom,
    make,
)

GAMES = ("breakout", "freeway", "space_invaders")


def played(env: gym.Env, seed: int, steps: int = 200) -> list[tuple[bytes, float, bool]]:
    """An episode of a fixed sequence of actions."""
    rng = np.random.default_rng(7)
    observation, _ = env.reset(seed=seed)
    seen = [(np.asarray(observation).tobytes(), 0.0, False)]
    for _ in range(steps):
        action = rng.integers(int(env.action_space.n))  # type: ignore[attr-defined]
        observation, reward, terminated, truncated, _ = env.step(action)
        seen.append((np.asarray(observation).tobytes(), float(reward), terminated))
        if terminated or truncated:
            break
    return seen


@pytest.mark.parametrize("name", [*GAMES, "masked", "identity"])
def test_the_tasks_pass_both_checks(name: str) -> None:
    if name in GAMES:
        pytest.importorskip("minatar", reason="needs the extra 'classic'")
        env: gym.Env = MinAtarEnv(name)
    else:
        env = MaskedIdentityEnv(size=12, n_valid=3) if name == "masked" else IdentityEnv(size=4)
    with warnings.catch_warnings():
        # both warn that nothing draws, and that NatureCNN, which is not used, needs 36 pixels
        warnings.filterwarnings("ignore", message=".*(render|36x36|spec).*")
        gymnasium_check(env, skip_render_check=True)
        sb3_check(env)


@pytest.mark.parametrize("game", GAMES)
def test_a_minatar_episode_depends_on_its_seed_alone(game: str) -> None:
    pytest.importorskip("minatar", reason="needs the extra 'classic'")
    env = MinAtarEnv(game)
    first = played(env, seed=3)
    played(env, seed=4)  # leaves another last action behind
    env.step(np.int64(0))
    assert played(env, seed=3) == first
    assert played(MinAtarEnv(game), seed=3) == first


def test_minatar_shows_the_games_own_state_with_sticky_actions_and_ramping() -> None:
    minatar = pytest.importorskip("minatar", reason="needs the extra 'classic'")
    env = MinAtarEnv("asterix")
    observation, _ = env.reset(seed=0)
    assert observation.shape == (4, 10, 10)
    assert observation[0].sum() == 255  # one player
    assert env._game.sticky_action_prob == minatar.Environment("asterix").sticky_action_prob == 0.1
    assert env._game.env.ramping is True
    assert MinAtarEnv("breakout").action_space.n == 3  # type: ignore[attr-defined]


def test_the_small_cnn_is_a_convolution() -> None:
    from benchmarks.studies.classic.features import SmallCnn

    extractor = SmallCnn(gym.spaces.Box(0, 255, (2, 10, 10), np.uint8))
    features = extractor(torch.rand(3, 2, 10, 10))
    assert features.shape == (3, extractor.features_dim) == (3, 16 * 8 * 8)
    assert [tuple(p.shape) for p in extractor.parameters()] == [(16, 2, 3, 3), (16,)]
    assert float(features.detach().min()) == 0.0


def test_the_masks_of_masked_identity_allow_the_right_action() -> None:
    env = make("MaskedIdentity", size=12, n_valid=3, length=20)
    state, _ = env.reset(seed=1)
    allowed = np.zeros(12)
    for _ in range(400):
        mask = env.get_wrapper_attr("action_masks")()
        assert mask.sum() == 3
        assert mask[state]
        allowed += mask
        state, reward, terminated, truncated, _ = env.step(state)
        assert (reward, terminated) == (1.0, False)
        if truncated:
            state, _ = env.reset()
    # every action is allowed one time in four
    assert allowed.min() > 60
    assert allowed.max() < 140
    assert env.step(np.int64((state + 1) % 12))[1] == 0.0


def test_identity_is_sb3s_and_an_episode_depends_on_its_seed_alone() -> None:
    env = make("Identity", size=4, length=100)
    first = played(env, seed=3)
    env.action_space.seed(0)
    assert played(env, seed=3) == first != played(env, seed=4)
    assert len(first) == 101  # observations of an episode
    state, _ = env.reset(seed=0)
    for _ in range(20):
        state, reward, terminated, _, _ = env.step(state)
        assert (reward, terminated) == (1.0, False)
    assert env.step((state + 1) % 4)[1] == 0.0


@pytest.mark.parametrize(
    ("name", "package", "message"),
    [
        ("NoSuch-v0", "", "unknown environment 'NoSuch-v0'"),
        ("MinAtar/pong", "minatar", "unknown MinAtar game 'pong'"),
        ("ALE/NoSuch-v5", "ale_py", "unknown environment 'ALE/NoSuch-v5'"),
        ("Lacking-v0", "", "'Lacking-v0' lacks a package: MuJoCo is not"),
        ("LunarLander-v3", "", r"LunarLander-v3 needs .* '\.\[classic\]'"),
    ],
)
def test_unknown_tasks_and_missing_packages_are_named(
    name: str, package: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lacking() -> Any:
        raise gym.error.DependencyNotInstalled("MuJoCo is not installed")

    if package:
        pytest.importorskip(package, reason="needs the extra 'classic'")
    spec: Any = gym.envs.registration.EnvSpec("Lacking-v0", entry_point=lacking)  # type: ignore[arg-type]
    monkeypatch.setitem(gym.registry, "Lacking-v0", spec)
    monkeypatch.setitem(sys.modules, "Box2D", None)
    with pytest.raises(BenchmarkError, match=message):
        make(name)


def test_no_module_of_a_file_is_imported(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (here / "evil.py").write_text("open('pwned', 'w')", encoding="utf-8")
    monkeypatch.syspath_prepend(str(here))
    with pytest.raises(BenchmarkError, match="'evil:X-v0': only coop_env's module is"):
        make("evil:X-v0")
    assert not (here / "pwned").exists()


def test_atari_is_scored_as_played_and_learned_in_by_signs_and_lives() -> None:
    pytest.importorskip("ale_py")
    results = {}
    for training in (False, True):
        env = make("ALE/Breakout-v5", training)
        assert env.observation_space.shape == (4, 84, 84)
        first, _ = env.reset(seed=3)
        assert (first == first[:1]).all()
        rng, rewards, lengths = np.random.default_rng(0), [], []
        for _ in range(6):
            over, steps = False, 0
            while not over:
                image, reward, terminated, truncated, _ = env.step(rng.integers(4))
                over, steps = terminated or truncated, steps + 1
                rewards.append(reward)
            assert env.observation_space.contains(image)
            lengths.append(steps)
            env.reset()
        results[training] = (rewards, lengths)
        env.close()
    assert set(results[True][0]) <= {-1.0, 0.0, 1.0}
    assert np.mean(results[True][1]) < np.mean(results[False][1])  # a life, not all five


def test_in_atari_an_action_in_a_thousand_is_random(monkeypatch: pytest.MonkeyPatch) -> None:
    """Dopamine's; without it a greedy policy has at most thirty episodes."""
    game: Any = IdentityEnv(size=6)
    taken = []
    monkeypatch.setattr(game, "step", lambda action: int(action))
    env: Any = NowAndThenRandom(game)
    for seed in (1, 1, 2):
        env.reset(seed=seed)
        taken.append(np.array([env.step(0) for _ in range(20_000)]))
    np.testing.assert_array_equal(taken[0], taken[1])
    assert (taken[0] != taken[2]).any()
    # five of six random actions are another: 16.7 of 20,000 on average
    assert 5 <= np.count_nonzero(taken[0]) <= 35


def test_a_game_depends_on_its_seed_alone_and_stacks_its_frames() -> None:
    pytest.importorskip("ale_py")
    played = []
    for _ in range(2):
        env = make("ALE/Pong-v5")
        images = [env.reset(seed=5)[0], *(env.step(a % 6)[0] for a in range(30))]
        np.testing.assert_array_equal(images[-1][:-1], images[-2][1:])
        played.append(np.stack(images))
        env.close()
    np.testing.assert_array_equal(played[0], played[1])
