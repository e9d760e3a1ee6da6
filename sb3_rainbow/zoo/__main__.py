"""``python -m sb3_rainbow.zoo``: train and enjoy of rl-baselines3-zoo, which knows Rainbow here."""

import argparse
import importlib
import sys
from importlib import metadata

import gymnasium as gym

from sb3_rainbow.masking.conventions import ActionMaskError
from sb3_rainbow.zoo.files import ZooError

_DESCRIPTION = """\
The scripts of rl-baselines3-zoo, with Rainbow among the algorithms.

  train    train, go on with a run (-i), search hyperparameters (-optimize)
  enjoy    watch a trained model

What follows the command goes to the script as it is (train -h lists it); --algo is rainbow unless
it says otherwise.
"""


def main() -> None:
    """Run a script of the zoo."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_rainbow.zoo",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("command", choices=("train", "enjoy"))
    parser.add_argument("arguments", nargs=argparse.REMAINDER)
    given = parser.parse_args()
    try:
        from sb3_rainbow.zoo.registration import register_for_playing, register_for_training
    except ModuleNotFoundError as error:
        sys.exit(f"{parser.prog}: {error.name} is missing: pip install 'sb3-rainbow-coop[zoo]'")
    try:
        _register_env(given.arguments)
        sys.argv = [f"{parser.prog} {given.command}", "--algo", "rainbow", *given.arguments]
        if given.command == "train":
            register_for_training()
            importlib.import_module("rl_zoo3.train").train()
        else:
            register_for_playing()
            # The folder where train leaves its runs; the zoo's own would be looked for on the hub.
            sys.argv[1:1] = ["-f", "logs"]
            importlib.import_module("rl_zoo3.enjoy").enjoy()
    except (ZooError, ActionMaskError) as error:
        sys.exit(f"{parser.prog} {given.command}: error: {error}")


def _register_env(arguments: list[str]) -> None:
    """Register the environment that the arguments name."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--env", default="CartPole-v1")
    parser.add_argument("--gym-packages", nargs="+", default=[])
    known, _ = parser.parse_known_args(arguments)
    try:
        for package in known.gym_packages:
            importlib.import_module(package)
        if known.env not in gym.registry:
            # Since 1.0 Gymnasium does not ask the package that a namespace is of any more.
            namespace = known.env.partition("/")[0]
            for plugin in metadata.entry_points(group="gymnasium.envs", name=namespace):
                plugin.load()()
        gym.spec(known.env)
    except (ModuleNotFoundError, gym.error.Error) as error:
        raise ZooError(f"no environment {known.env}: {error}") from error


if __name__ == "__main__":
    main()
