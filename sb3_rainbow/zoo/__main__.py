"""``python -m sb3_rainbow.zoo``: the scripts of rl-baselines3-zoo, to which Rainbow is known."""

import argparse
import importlib
import runpy
import sys
from importlib import metadata

from sb3_rainbow.masking.conventions import ActionMaskError

_DESCRIPTION = """\
The scripts of rl-baselines3-zoo, with Rainbow among the algorithms.

  train    train, go on with a run (-i), search hyperparameters (-optimize)
  enjoy    watch a trained model
  record   make a video of it (the zoo's record_video)
  push     package it for the Hugging Face hub, and upload it

What follows the command goes to the script as it is (train -h lists it); --algo is rainbow unless
it says otherwise.
"""


def main() -> None:
    """Hand over to a script of the zoo."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_rainbow.zoo",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("command", choices=("train", "enjoy", "record", "push"))
    parser.add_argument("arguments", nargs=argparse.REMAINDER)
    given = parser.parse_args()
    try:
        from sb3_rainbow.zoo.files import ZooError
        from sb3_rainbow.zoo.registration import register_for_playing, register_for_training
    except ModuleNotFoundError as error:
        sys.exit(f"{parser.prog}: {error.name} is missing: pip install 'sb3-rainbow-coop[zoo]'")
    try:
        arguments = _with_known_env(given.command, given.arguments)
        sys.argv = [f"{parser.prog} {given.command}", "--algo", "rainbow", *arguments]
        if given.command == "train":
            register_for_training()
            importlib.import_module("rl_zoo3.train").train()
            return
        register_for_playing()
        if given.command == "push":
            importlib.import_module("sb3_rainbow.zoo.push").main()
            return
        # The folder where train leaves its runs; the zoo's own would be looked for on the hub.
        sys.argv[1:1] = ["-f", "logs"]
        if given.command == "enjoy":
            importlib.import_module("rl_zoo3.enjoy").enjoy()
        else:
            runpy.run_module("rl_zoo3.record_video", run_name="__main__")
    except (ZooError, ActionMaskError) as error:
        sys.exit(f"{parser.prog} {given.command}: error: {error}")


def _with_known_env(command: str, arguments: list[str]) -> list[str]:
    """The arguments, once the environment that they name is registered.

    Raises:
        ZooError: for one that is not.
    """
    import gymnasium as gym

    from sb3_rainbow.zoo.files import ZooError

    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--env", default="CartPole-v1")
    parser.add_argument("--gym-packages", nargs="+", default=[])
    known, others = parser.parse_known_args(arguments)
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
    # Its record_video knows no --gym-packages.
    return ["--env", known.env, *others] if command == "record" else arguments


if __name__ == "__main__":
    main()
