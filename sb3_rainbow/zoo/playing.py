"""Rainbow as the zoo's scripts play a trained model: without a replay buffer, under masks."""

import functools
import pathlib
from typing import Any, ClassVar, TypeVar

import rl_zoo3.utils
from numpy.typing import NDArray
from sb3_contrib.common.maskable.utils import get_action_masks, is_masking_supported
from stable_baselines3.common.vec_env import VecEnv

from sb3_rainbow.rainbow import Rainbow
from sb3_rainbow.type_aliases import ObsArray, SaveFile
from sb3_rainbow.zoo.files import is_model_file, loading
from sb3_rainbow.zoo.model_file import read_model

SelfPlayed = TypeVar("SelfPlayed", bound="PlayedRainbow")


class PlayedRainbow(Rainbow):
    """A trained model under the masks of the environment that :func:`create_test_env` made last.

    The zoo's ``enjoy`` loads a model without its environment and asks it for actions by the
    observations alone: masks have no other way to it.
    """

    played: ClassVar[VecEnv | None] = None

    @classmethod
    def load(cls: type[SelfPlayed], path: SaveFile, *args: Any, **kwargs: Any) -> SelfPlayed:
        """As ``Rainbow.load``, with the smallest replay buffer unless one is asked for.

        A packaged file is read without running anything of it.

        Raises:
            ZooError: if it cannot be loaded.
        """
        if isinstance(path, str | pathlib.Path) and is_model_file(path):
            kwargs.pop("custom_objects", None)  # for what a pickle names
            return read_model(path, cls, *args, **kwargs)
        with loading(str(path)):
            return super().load(path, *args, **{"buffer_size": 1, **kwargs})

    def predict(
        self,
        observation: ObsArray,
        state: tuple[NDArray, ...] | None = None,
        episode_start: NDArray | None = None,
        deterministic: bool = False,
        action_masks: NDArray | None = None,
    ) -> tuple[NDArray, tuple[NDArray, ...] | None]:
        """As ``Rainbow.predict``; without masks, under those of the environment that is played."""
        env = self.played
        if action_masks is None and env is not None and masks_apply(self, env):
            action_masks = get_action_masks(env)
        return super().predict(observation, state, episode_start, deterministic, action_masks)


def masks_apply(model: object, env: VecEnv) -> bool:
    """Whether a model is to act under the masks of an environment."""
    return (
        isinstance(model, Rainbow) and model.use_masking is not False and is_masking_supported(env)
    )


_create_test_env = rl_zoo3.utils.create_test_env


@functools.wraps(_create_test_env)
def create_test_env(*args: Any, **kwargs: Any) -> VecEnv:
    """The zoo's, remembered for :class:`PlayedRainbow`."""
    PlayedRainbow.played = _create_test_env(*args, **kwargs)
    return PlayedRainbow.played
