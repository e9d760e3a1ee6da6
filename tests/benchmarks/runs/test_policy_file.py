"""The final policy's file: small, SB3's own form, and exactly what was tested."""

import copy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from benchmarks.evaluation.evaluate import evaluate_cell
from benchmarks.evaluation.model_files import load_stored
from benchmarks.methods.learners import build_model, make_training_env
from benchmarks.protocol.learners import LEARNERS
from benchmarks.protocol.plan import Cell
from benchmarks.protocol.seeding import derive
from benchmarks.runs import policy_file
from benchmarks.runs.cell import run_cell
from benchmarks.runs.store import Store
from benchmarks.studies.insertion import Insertion
from tests.benchmarks.smoke import SMALL, smoke, smoke_preset

METHODS = [name for name, each in LEARNERS.items() if each.discrete]
TEAMS = ("central", "vdn", "vdn_sight", "shared", "shared_sight", "independent_sight")


PPO = {"n_steps": 16, "batch_size": 16, "n_epochs": 1}
OWN = {"qrdqn": {"policy_kwargs": {"net_arch": [64, 64], "n_quantiles": 20}}}
TRACKS = smoke({"ppo": PPO, "methods": OWN})["tracks"]
TRACKS |= {team: {"timesteps": 200, "hyperparameters": SMALL} for team in TEAMS}
PRESET = smoke_preset(tracks=TRACKS, evaluation={"episodes": 3, "noise": [0.0]})


@pytest.mark.parametrize(
    ("method", "track"), [*((name, "safe") for name in METHODS), *(("rainbow", t) for t in TEAMS)]
)
def test_the_stored_policy_repeats_the_episodes(method: str, track: str, tmp_path: Path) -> None:
    cell = Cell(method, "full", "optimized", track, 0)
    store = Store.open(tmp_path, "smoke", create=True)
    assert run_cell(Insertion(PRESET), cell, store)
    run = store.run(cell.id)
    assert run.policy.stat().st_size < 400_000
    assert len(run.meta()["training"]["weights_sha256"]) == 64
    model = load_stored(run.policy)
    if method == "qrdqn":
        assert model.policy_kwargs["n_quantiles"] == 20
    if method in ("dqn", "qrdqn"):
        assert model.exploration_rate == PRESET.tracks[track].hyperparameters.epsilon_end > 0.0
    assert ("methods" in run.config()["track"]) == (method == "qrdqn")
    again = evaluate_cell(PRESET, cell, model=model)
    stored = run.rows("episodes")
    assert [row["reward"] for row in again] == pytest.approx(stored["reward"].tolist(), rel=1e-6)
    assert [row["moves"] for row in again] == stored["moves"].tolist()


@pytest.mark.parametrize("method", METHODS)
def test_half_precision_moves_no_weight_further_than_its_last_bit(method: str) -> None:
    cell = Cell(method, "full", "optimized", "safe", derive("learner", 3) % 1000)
    model = build_model(PRESET, cell, make_training_env(PRESET, cell))
    before = {k: v.clone() for k, v in model.policy.state_dict().items()}
    whole = policy_file.digest(model)
    policy_file.reduce_to_acting(model)
    assert policy_file.digest(model) != whole
    of_actor = ("action_net.", "mlp_extractor.policy_net.")
    acting = {"rainbow": "q_net.", "dqn": "q_net.", "qrdqn": "quantile_net."}.get(method, of_actor)
    compared = 0
    for name, value in model.policy.state_dict().items():
        if name.startswith(acting) and not name.endswith(("epsilon_in", "epsilon_out")):
            torch.testing.assert_close(value, before[name], rtol=2**-11, atol=2**-24)
            compared += 1
    assert compared >= 6  # two layers and the outputs


def test_a_learner_that_is_built_writes_nothing_into_its_preset() -> None:
    preset = smoke_preset(tracks=copy.deepcopy(TRACKS))
    cell = Cell("qrdqn", "full", "optimized", "safe", 0)
    build_model(preset, cell, make_training_env(preset, cell))
    assert preset == smoke_preset(tracks=TRACKS)


def test_a_policy_of_ones_own_may_act_by_a_part_of_any_name() -> None:
    policy: Any = torch.nn.Module()
    policy.critic = torch.nn.Linear(3, 2)
    policy.critic.weight.data.fill_(1.0 / 3.0)
    policy.critic.bias.data.fill_(1e5)  # half precision ends before
    model = SimpleNamespace(policy=policy, _get_torch_save_params=lambda: ([], []))
    policy_file.reduce_to_acting(model)
    torch.testing.assert_close(policy.critic.weight, torch.full((2, 3), 1.0 / 3.0).half().float())
    assert policy.critic.bias.tolist() == [1e5, 1e5]


def test_a_digest_is_of_every_name_and_bit() -> None:
    found = set()
    for parts in ({"a": 1.0, "b": 2.0}, {"a": 1.0, "b": 2.0 + 2**-22}, {"a": 1.0, "c": 2.0}):
        state = {name: torch.tensor(number) for name, number in parts.items()}
        found.add(policy_file.digest(SimpleNamespace(policy=torch.nn.ParameterDict(state))))
    assert len(found) == 3
