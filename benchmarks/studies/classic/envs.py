"""The public tasks by name; those that Gymnasium lacks: MinAtar, identity, masked identity.

Atari's games are as data-efficient Rainbow plays them, through ale-py and SB3's wrappers.
"""

import importlib
import warnings
from typing import Any, Final

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import FrameStackObservation, ReshapeObservation
from numpy.typing import NDArray
from stable_baselines3.common import envs

from benchmarks.errors import BenchmarkError
from benchmarks.protocol.plan import ATARI

MINATAR: Final = "MinAtar/"
MASKED_IDENTITY: Final = "MaskedIdentity"
NO_ACTION: Final = 0  # "n", of MinAtar's six
FRAMES: Final = 4  # stacked
EPISODE_STEPS: Final = 27_000  # half an hour of play at 60 frames a second, 4 of them a step
MINATAR_STEPS: Final = 5_000  # after which an episode is truncated, too
NOOPS: Final = 30  # at most, at the start of an episode
EPSILON: Final = 0.001  # of a test's actions are random (Dopamine): else at most 30 episodes differ


def make(name: str, training: bool = False, **kwargs: Any) -> gym.Env[Any, Any]:
    """An environment by name: a Gymnasium id, ``MinAtar/<game>``, or one of three names.

    ``Identity``, ``MaskedIdentity``, and SB3's ``BitFlipping``. Atari's games differ in
    ``training`` from what is scored.

    Raises:
        BenchmarkError: the name is unknown or another module's, or its package is not installed.
    """
    if name.startswith(MINATAR):
        # Looked up late: rl_zoo3 puts another in its place, and pickle refuses the one it replaced
        return gym.wrappers.TimeLimit(
            MinAtarEnv(name.removeprefix(MINATAR), **kwargs), MINATAR_STEPS
        )
    if name.startswith(ATARI):
        return make_atari(name, training, **kwargs)
    if name in BY_NAME:
        return BY_NAME[name](**kwargs)
    if name.startswith("LunarLander"):
        _import("Box2D", name)
    return _registered(name, **kwargs)


def _registered(name: str, **kwargs: Any) -> gym.Env[Any, Any]:
    if name.rpartition(":")[0] not in ("", "coop_env"):  # Gymnasium imports what stands there
        message = f"environment '{name}': only coop_env's module is imported; name a registered id"
        raise BenchmarkError(message)
    try:
        return gym.make(name, disable_env_checker=True, **kwargs)
    except gym.error.DependencyNotInstalled as error:
        raise BenchmarkError(f"environment '{name}' lacks a package: {error}") from error
    except gym.error.Error as error:
        raise BenchmarkError(f"unknown environment '{name}': {error}") from error


def _import(module: str, what: str) -> Any:
    with warnings.catch_warnings():
        # SWIG's types warn at import; as an error, that warning would crash the interpreter
        warnings.simplefilter("ignore", DeprecationWarning)
        try:
            return importlib.import_module(module)
        except ImportError as error:
            raise BenchmarkError(
                f"{what} needs the package {module} ({error}); pip install -e '.[classic]'"
            ) from error


class NowAndThenRandom(gym.Wrapper[NDArray[np.uint8], Any, NDArray[np.uint8], Any]):
    """Takes a random action with a probability of :data:`EPSILON`, drawn from the reset's seed."""

    def __init__(self, env: gym.Env[NDArray[np.uint8], Any]) -> None:
        super().__init__(env)
        self._rng = np.random.default_rng()

    def reset(self, **given: Any) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        """As the game's, with a generator of this seed's own."""
        if given.get("seed") is not None:
            self._rng = np.random.default_rng(given["seed"])
        return self.env.reset(**given)

    def step(self, action: Any) -> tuple[NDArray[np.uint8], Any, bool, bool, dict[str, Any]]:
        """As the game's, but now and then with another action."""
        assert isinstance(self.action_space, gym.spaces.Discrete)
        if self._rng.random() < EPSILON:
            action = self._rng.integers(self.action_space.n)
        return self.env.step(action)


def make_atari(name: str, training: bool = False) -> gym.Env[NDArray[np.uint8], Any]:
    """A game of Atari, ``ALE/<Game>-v5``: no sticky actions, four frames a step, up to 30 no-ops.

    Observations are the last four grey frames, (4, 84, 84), uint8; at first all are the first. No
    game is begun by FIRE, as in Dopamine. In ``training`` rewards are cut to their signs, and a
    life lost ends the episode; otherwise now and then an action is random.
    """
    ale_py = _import("ale_py", name)
    _import("cv2", name)  # which SB3's wrapper needs
    from stable_baselines3.common import atari_wrappers as sb3

    gym.register_envs(ale_py)
    ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)
    rules = {"frameskip": 1, "repeat_action_probability": 0.0}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        env = _registered(name, max_episode_steps=4 * EPISODE_STEPS, **rules)
    wrapped: gym.Env[Any, Any] = sb3.MaxAndSkipEnv(sb3.NoopResetEnv(env, NOOPS), FRAMES)
    if training:
        wrapped = sb3.EpisodicLifeEnv(wrapped)
    wrapped = sb3.WarpFrame(wrapped)
    wrapped = sb3.ClipRewardEnv(wrapped) if training else NowAndThenRandom(wrapped)
    stacked = FrameStackObservation(wrapped, FRAMES)
    return ReshapeObservation(stacked, (FRAMES, *wrapped.observation_space.shape[:2]))  # type: ignore[index]


class MinAtarEnv(gym.Env[NDArray[np.uint8], np.int64]):
    """A MinAtar game (Young and Tian 2019) as an image with channels first.

    Sticky actions (probability 0.1) and difficulty ramping are MinAtar's defaults. Observations
    have shape (channels, 10, 10), uint8, 0 or 255; actions are the game's own minimal set. The
    first frame follows "no action", so that an episode depends on its seed alone.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - as Gymnasium declares it

    def __init__(self, game: str) -> None:
        module = _import("minatar", f"MinAtar's {game}")
        try:
            self._game = module.Environment(game)
        except ModuleNotFoundError as error:
            raise BenchmarkError(f"unknown MinAtar game '{game}'") from error
        self._actions: list[int] = self._game.minimal_action_set()
        rows, columns, channels = self._game.state_shape()
        self.observation_space = spaces.Box(0, 255, (channels, rows, columns), np.uint8)
        self.action_space = spaces.Discrete(len(self._actions))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        if seed is not None:
            self._game.seed(int(self.np_random.integers(2**31)))
        self._game.last_action = NO_ACTION
        self._game.reset()
        return self._observation(), {}

    def step(self, action: np.int64) -> tuple[NDArray[np.uint8], float, bool, bool, dict[str, Any]]:
        """One frame."""
        reward, terminated = self._game.act(self._actions[int(action)])
        return self._observation(), float(reward), bool(terminated), False, {}

    def _observation(self) -> NDArray[np.uint8]:
        state = self._game.state().astype(np.uint8) * np.uint8(255)
        return np.ascontiguousarray(state.transpose(2, 0, 1))


class IdentityEnv(envs.IdentityEnv[Any]):
    """SB3's task: reward 1 for naming the observed one of ``size`` states, else 0.

    Its states follow ``reset(seed=...)``. Observations and actions: Discrete(size).
    """

    def __init__(self, size: int = 4, length: int = 100) -> None:
        super().__init__(size, ep_length=length)

    def _choose_next_state(self) -> None:
        self.state = self.np_random.integers(self.action_space.n)  # type: ignore[attr-defined]


class MaskedIdentityEnv(IdentityEnv):
    """:class:`IdentityEnv` in which few actions are allowed.

    At each step the right action and ``n_valid - 1`` others, drawn at random, are allowed. A
    learner that reads ``action_masks()`` finds the right one sooner. A forbidden action gives 0,
    like any wrong one.
    """

    def __init__(self, size: int = 100, n_valid: int = 5, length: int = 50) -> None:
        if not 1 <= n_valid <= size:
            raise BenchmarkError(f"n_valid = {n_valid} must lie between 1 and size = {size}")
        self._n_valid, self._mask = n_valid, np.ones(size, dtype=bool)
        super().__init__(size, length)

    def action_masks(self) -> NDArray[np.bool_]:
        """True where allowed, shape ``(size,)``."""
        return self._mask.copy()

    def _choose_next_state(self) -> None:
        super()._choose_next_state()
        size = len(self._mask)
        others = self.np_random.choice(size - 1, self._n_valid - 1, replace=False)
        self._mask = np.zeros(size, dtype=bool)
        self._mask[others + (others >= self.state)] = True
        self._mask[self.state] = True


BY_NAME: Final[dict[str, type[gym.Env[Any, Any]]]] = {
    "Identity": IdentityEnv,
    MASKED_IDENTITY: MaskedIdentityEnv,
    "BitFlipping": envs.BitFlippingEnv,
}
