"""Rainbow by the zoo's train and enjoy: its hyperparameters, its masks, its search."""

from importlib import resources
from pathlib import Path

import numpy as np
import optuna
import pytest
import yaml
from stable_baselines3 import DQN

from sb3_rainbow.zoo.experiments import ENTRY
from sb3_rainbow.zoo.registration import convert_rainbow_params, sample_rainbow_params
from tests.sb3_rainbow.zoo import environments
from tests.sb3_rainbow.zoo.runs import ENVS, SMALL, train, trained, workplace, zoo

__all__ = ["workplace"]
HYPERPARAMS = resources.files("sb3_rainbow.zoo") / "hyperparams.yml"
OURS = yaml.safe_load(HYPERPARAMS.read_text(encoding="utf-8"))


def test_train_evaluates_and_enjoy_plays(capsys: pytest.CaptureFixture[str]) -> None:
    train("--eval-freq 200 --eval-episodes 2")
    assert trained(1).num_timesteps == 600
    evaluations = np.load("logs/rainbow/CartPole-v1_1/evaluations.npz")
    assert evaluations["timesteps"].tolist() == [200, 400, 600]
    zoo("enjoy --env CartPole-v1 --no-render -n 60 --load-best")
    assert "Mean reward" in capsys.readouterr().out


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # Box2D's, as it is imported
@pytest.mark.parametrize("env_id", {repr(v): k for k, v in OURS.items() if "-v" in k}.values())
def test_the_hyperparameters_of_the_package(env_id: str) -> None:
    if env_id.startswith("MinAtar/"):
        pytest.importorskip("minatar", reason="needs the extra classic")
    packages = "--gym-packages coop_env" if env_id.startswith("Coop") else ""
    zoo(f"train --env {env_id} {packages} -n 64 --eval-freq -1 --seed 1 --device cpu --verbose 0")
    model = trained(1, env_id.replace("/", "-"))
    for name in {"v_min", "v_max", "gamma", "tau", "batch_size", "n_atoms"} & OURS[env_id].keys():
        assert getattr(model, name) == OURS[env_id][name]
    assert model.num_timesteps == 64


MASKED = f"--env MaskedZoo-v0 --gym-packages {ENVS}"


def test_all_is_played_under_masks() -> None:
    """The environment raises where it is not."""
    train(f"{MASKED} --eval-freq 200 --eval-episodes 2 -n 400")
    zoo(f"enjoy {MASKED} --no-render -n 60")
    zoo(f"enjoy {MASKED} --no-render -n 60 --stochastic")
    train(f"{MASKED} -n 200 -optimize --n-trials 2 --n-evaluations 1 --no-optim-plots")
    with pytest.raises(RuntimeError, match="not under masks"):
        train(f"{MASKED} -n 400 --hyperparams use_masking:False")


def test_a_trial_explores_and_is_the_same_once_it_is_stored() -> None:
    """Where the entry has noise alone, uniform replay, a support or an interval of its target."""
    for name in ("CartPole-v1", "MinAtar/Breakout-v1", "CoopInsertion-v0", "atari"):
        entry = OURS[name]
        seen = set()
        for number in range(12):
            study = optuna.create_study(sampler=optuna.samplers.RandomSampler(number))
            trial = study.ask()
            trial.set_user_attr(ENTRY, sorted(entry))
            drawn = sample_rainbow_params(trial, 12, 1, {})
            study.tell(trial, 0.0)
            assert convert_rainbow_params(study.best_trial.params) == drawn
            settings = {**entry, **drawn}
            assert settings["prioritized"]
            assert settings["target_update_interval"] is None
            assert ("policy_kwargs" in drawn) == ("policy_kwargs" not in entry)
            if not settings["noisy"]:
                assert settings["exploration_initial_eps"] > settings["exploration_final_eps"] > 0
            assert ("gamma" in drawn) == ("v_max" not in entry)
            seen.add(settings["noisy"])
        assert seen == {True, False}


def test_a_search_keeps_a_buffer_of_the_entrys_and_what_it_cannot_store() -> None:
    """Priorities and n-step returns; what hindsight draws stays as well."""
    buffer = {
        "replay_buffer_class": "HerReplayBuffer",
        "replay_buffer_kwargs": "dict(n_sampled_goal=2)",
    }
    entry = {**SMALL, **buffer, "policy": "MultiInputPolicy", "prioritized": False, "n_steps": 1}
    Path("small.yml").write_text(yaml.safe_dump({"BitsZoo-v0": entry}), encoding="utf-8")
    trials = "-n 200 -optimize --n-trials 2 --n-evaluations 1 --no-optim-plots"
    train(f"--env BitsZoo-v0 --gym-packages {ENVS} {trials}")


def test_a_game_of_atari_has_its_entry() -> None:
    pytest.importorskip("ale_py", reason="needs the extra classic")
    zoo(
        "train --env ALE/Pong-v5 --gym-packages ale_py -n 8 --eval-freq -1 --device cpu --verbose 0"
    )
    model = trained(1, "ALE-Pong-v5")
    assert model.observation_space.shape == (4, 84, 84)
    assert (model.v_max, model.n_steps) == (10.0, 10)


def test_arguments_of_the_environment_reach_the_evaluation(monkeypatch: pytest.MonkeyPatch) -> None:
    """The zoo keeps those of the hyperparameters to the training."""
    monkeypatch.setattr(environments.Masked, "tags", [])
    entry = {"MaskedZoo-v0": {**SMALL, "env_kwargs": {"tag": "given"}}}
    Path("small.yml").write_text(yaml.safe_dump(entry), encoding="utf-8")
    train(f"{MASKED} --eval-freq 100 --eval-episodes 1 -n 100")
    assert environments.Masked.tags == ["given"] * 2
    train(f"{MASKED} --eval-freq 100 --eval-env-kwargs tag:'other' -n 100")
    assert sorted(environments.Masked.tags[2:]) == ["given", "other"]


def test_the_zoos_own_algorithms_stay_as_they_are() -> None:
    zoo(
        "train --algo dqn -n 100 --eval-freq 50 --eval-episodes 1 --seed 0 --device cpu --verbose 0"
    )
    assert DQN.load("logs/dqn/CartPole-v1_1/CartPole-v1.zip").num_timesteps >= 100


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("train --env CartPol-v1", "no environment CartPol-v1: .*Did you mean: `CartPole`?"),
        ("enjoy --env CartPol-v1", "no environment CartPol-v1"),
        ("train --gym-packages no_such", "No module named 'no_such'"),
        (
            f"train {MASKED} --env-kwargs n_masks:3 --conf-file small.yml --eval-freq -1",
            r"shape \(1, 4\) \(envs, actions\), got \(1, 3\)",
        ),
        (
            f"train {MASKED} --env-kwargs n_masks:3 --conf-file small.yml -optimize --n-trials 2",
            r"shape \(1, 4\) \(envs, actions\), got \(1, 3\)",
        ),
        ("train -i other.zip --conf-file small.yml", "other.zip .* saved by another algorithm"),
        ("train -i text.zip --conf-file small.yml", "text.zip .* wasn't a zip-file"),
    ],
)
def test_bad_input_is_one_clear_error(command: str, message: str) -> None:
    DQN("MlpPolicy", "CartPole-v1", buffer_size=10, device="cpu").save("other")
    Path("text.zip").write_text("no archive")
    with pytest.raises(SystemExit, match=rf"python -m sb3_rainbow.zoo \w+: error: .*{message}"):
        zoo(command)


def test_enjoy_refuses_a_file_of_another_algorithm() -> None:
    train("-n 50")
    model = DQN("MlpPolicy", "CartPole-v1", buffer_size=10, device="cpu")
    model.save("logs/rainbow/CartPole-v1_1/CartPole-v1.zip")
    with pytest.raises(SystemExit, match=r"cannot be loaded as Rainbow: .* another algorithm"):
        zoo("enjoy --env CartPole-v1 --no-render")
