"""The zoo's -i with --save-replay-buffer: a run goes on where it stopped."""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_rainbow import Rainbow
from sb3_rainbow.zoo import hub
from tests.sb3_rainbow.zoo.runs import train, trained, workplace

__all__ = ["workplace"]
RUN = Path("logs/rainbow/CartPole-v1_1")


class Interrupt(BaseCallback):
    """Ctrl-C at the 300th step."""

    def _on_step(self) -> bool:
        if self.n_calls == 300:
            raise KeyboardInterrupt
        return True


def test_after_ctrl_c_counters_schedules_and_replay_go_on() -> None:
    train(f"--save-replay-buffer --hyperparams callback:'{__name__}.Interrupt'")
    first = trained(1)
    assert 298 <= first.num_timesteps <= 300
    train(f"--save-replay-buffer -i {RUN}/CartPole-v1.zip")
    second = trained(2)
    assert second.num_timesteps == second._total_timesteps == 600
    # Four updates every two steps, from the 40th on: nothing was random a second time.
    assert second._n_updates == pytest.approx(1120, abs=12)
    assert second.policy.optimizer.param_groups[0]["lr"] < 1e-5
    old: Any = first.replay_buffer
    new: Any = second.replay_buffer
    n = old.size() - 5
    np.testing.assert_array_equal(old.observations[:n], new.observations[:n])
    assert new.size() == pytest.approx(600, abs=2)


def test_a_new_seed_is_no_second_beginning() -> None:
    """The first episodes after a resume are not those of the run's beginning."""
    train("--save-replay-buffer -n 300")
    train(f"--save-replay-buffer -i {RUN}/CartPole-v1.zip -n 400")
    buffer: Any = trained(2).replay_buffer
    assert not (buffer.observations[300:305] == buffer.observations[0]).all(axis=-1).any()


@pytest.mark.parametrize(("flag", "n", "total"), [("--save-replay-buffer", 100, 200), ("", 50, 50)])
def test_a_finished_run_takes_as_many_steps_again(flag: str, n: int, total: int) -> None:
    """Without its replay buffer a model is where a new run begins."""
    train(f"{flag} -n 100")
    train(f"-i {RUN}/CartPole-v1.zip -n {n}")
    assert trained(2).num_timesteps == total


def test_the_runs_own_settings_win_unless_the_command_line_speaks() -> None:
    train("--save-replay-buffer -n 100 --hyperparams gamma:0.9 max_grad_norm:3.0")
    train(f"--save-replay-buffer -i {RUN}/CartPole-v1.zip -n 200 --hyperparams max_grad_norm:2.0")
    assert (trained(2).gamma, trained(2).max_grad_norm) == (0.9, 2.0)


def test_statistics_of_observations_go_on() -> None:
    settings = "--save-replay-buffer --hyperparams normalize:True"
    train(f"{settings} -n 300 --save-freq 200")
    train(f"{settings} -i {RUN}/checkpoint.zip -n 600")
    counts = []
    for number in (1, 2):
        folder = Path(f"logs/rainbow/CartPole-v1_{number}/CartPole-v1")
        counts.append(pickle.loads((folder / "vecnormalize.pkl").read_bytes()).obs_rms.count)
    assert trained(2).num_timesteps == 600
    assert counts == [pytest.approx(301, abs=1), pytest.approx(602, abs=2)]


def test_a_checkpoint_of_other_settings_is_named() -> None:
    train("--save-replay-buffer --save-freq 50 -n 100 --hyperparams n_steps:2")
    for file in ("checkpoint.zip", "CartPole-v1.zip"):
        with pytest.raises(SystemExit, match=f"{file} cannot be loaded as Rainbow: .*n_steps=2"):
            train(f"-i {RUN}/{file} --hyperparams n_steps:4")


def test_a_packaged_model_goes_on_by_the_statistics_beside_it() -> None:
    env = VecNormalize(make_vec_env("CartPole-v1"))
    model = Rainbow("MlpPolicy", env, learning_starts=10, buffer_size=500, device="cpu").learn(300)
    path = hub.package(model, "CartPole-v1", "out", eval_env=env, command="", n_eval_episodes=1)
    train(f"-i {path} -n 50 --env CartPole-v1 --hyperparams normalize:True")
    saved = Path("logs/rainbow/CartPole-v1_1/CartPole-v1/vecnormalize.pkl")
    went_on: Any = VecNormalize.load(str(saved), make_vec_env("CartPole-v1"))
    assert went_on.obs_rms.count > 300
    with pytest.raises(SystemExit, match="normalize:True"):
        train(f"-i {path} -n 50 --env CartPole-v1")
