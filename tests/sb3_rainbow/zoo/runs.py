"""Short runs by the zoo's command line, in this process."""

import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import gymnasium.envs.registration
import pytest
import yaml

from sb3_rainbow import Rainbow

pytest.importorskip("rl_zoo3", reason="needs the extra zoo")

SMALL: dict[str, Any] = {
    "policy": "MlpPolicy",
    "n_timesteps": 600,
    "learning_rate": "lin_1e-3",
    "learning_starts": 40,
    "train_freq": 2,
    "buffer_size": 2000,
    "batch_size": 8,
    "policy_kwargs": {"net_arch": [16, 16]},
}
ENVS = "tests.sb3_rainbow.zoo.environments"


@pytest.fixture(autouse=True)
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder to work in; Gymnasium's TimeLimit, which the zoo replaces, comes back."""
    for module in (gym.wrappers, gym.wrappers.common, gymnasium.envs.registration):
        monkeypatch.setattr(module, "TimeLimit", module.TimeLimit)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    everything = dict.fromkeys(("CartPole-v1", "default"), SMALL)
    Path("small.yml").write_text(yaml.safe_dump(everything), encoding="utf-8")
    return tmp_path


def zoo(command: str) -> None:
    """``python -m sb3_rainbow.zoo`` with these arguments."""
    from sb3_rainbow.zoo.__main__ import main

    before, sys.argv = sys.argv, ["zoo", *command.split()]
    try:
        main()
    finally:
        sys.argv = before


def train(arguments: str = "") -> None:
    """A training of CartPole, small and without evaluation unless the arguments say otherwise."""
    zoo(f"train --conf-file small.yml --eval-freq -1 --seed 3 --device cpu --verbose 0 {arguments}")


def trained(number: int, env: str = "CartPole-v1") -> Rainbow:
    """The model of the n-th run of an environment, with its replay buffer."""
    folder = Path("logs/rainbow") / f"{env}_{number}"
    model = Rainbow.load(folder / f"{env}.zip")
    if (folder / "replay_buffer.pkl").exists():
        model.load_replay_buffer(folder / "replay_buffer.pkl")
    return model
