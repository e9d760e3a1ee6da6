"""Presets are strict: whatever a file gets wrong is named, with the file and what is known."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from benchmarks.cli import main
from benchmarks.errors import BenchmarkError
from benchmarks.protocol.labels import knowledge
from benchmarks.protocol.plan import ABLATIONS, CONTROLS, GEOMETRIES, METHODS, expand, settings
from benchmarks.protocol.presets import (
    PRESETS,
    Controls,
    Preset,
    load,
    load_preset,
    preset_names,
)
from benchmarks.studies.insertion import Insertion
from coop_env.geometry import GEOMETRIES as KNOWN
from coop_env.simulation.rewards import make_reward
from tests.benchmarks.smoke import parsed, smoke, smoke_preset

SMALL_BASE = {"base_radius": 0.1, "proximal_length": 0.1, "platform_radius": 0.2}


def safe(**track: Any) -> dict[str, Any]:
    return {"tracks": {"safe": track}}


def mine(**track: Any) -> dict[str, Any]:
    return {"tracks": {"mine": track}}


def unsure(**knobs: float) -> dict[str, Any]:
    """On a machine with these errors."""
    return mine(base="safe", sim_to_real=knobs)


@pytest.mark.parametrize("name", ["smoke", "quick", "grid", "paper", "cut", "team"])
def test_shipped_presets_expand_to_cells_with_unique_folders(name: str) -> None:
    cells = expand(load_preset(name))
    assert len({cell.id for cell in cells}) == len(cells) > 0
    assert name in preset_names()


def test_a_group_of_runs_may_have_seeds_of_its_own() -> None:
    runs = [
        {"methods": ["greedy"], "tracks": ["safe"], "seeds": [7]},
        {"methods": ["optimum"]},
    ]
    cells = expand(smoke_preset(seeds=[0, 1], runs=runs, design=None))
    assert {(c.method, c.seed) for c in cells} == {("greedy", 7), ("optimum", 0), ("optimum", 1)}


def test_the_quick_preset_fills_every_row_of_the_papers_tables() -> None:
    ids = {cell.id for cell in expand(load_preset("quick"))}
    wanted = {f"rainbow-{a}-optimized-safe-s0" for a in ABLATIONS if a != "full"}
    wanted |= {"rainbow-optimized-safe-s0", "rainbow-initial-safe-s0", "dqn-optimized-safe-s0"}
    wanted |= {"rrt_connect-optimized-s0", "optimum-optimized-s0", "optimum-initial-s0", "design"}
    assert wanted <= ids


def test_the_paper_preset_has_the_papers_protocol_and_hyperparameters() -> None:
    preset = load_preset("paper")
    assert len(preset.seeds) == 5
    assert preset.evaluation.episodes == 100
    track = preset.tracks["printed"]
    h = track.hyperparameters
    assert (track.reward, track.timesteps) == ("paper", 1_500_000)
    assert (h.learning_rate, h.weight_decay, h.max_grad_norm, h.gamma) == (1e-4, 1e-5, 5.0, 0.99)
    assert (h.n_steps, h.buffer_size, h.alpha, h.beta_start, h.beta_end) == (3, 10**6, 0.6, 0.4, 1)
    assert (h.batch_size, h.tau, h.n_atoms, h.v_min, h.v_max) == (64, 1e-3, 51, -10.0, 200.0)
    assert (track.curriculum.threshold, track.curriculum.window) == (0.75, 20)
    assert (h.epsilon_start, h.epsilon_end, h.epsilon_steps) == (1.0, 0.05, 10_000)


def test_geometries_and_rewards_are_those_of_the_task() -> None:
    assert set(GEOMETRIES) == set(KNOWN)
    for track in load_preset("cut").tracks.values():
        make_reward(track.reward, dict(track.reward_kwargs))


@pytest.mark.parametrize(
    ("path", "key"),
    [
        ((), "sedes"),
        (("evaluation",), "episode"),
        (("tracks", "safe"), "timestep"),
        (("tracks", "safe", "hyperparameters"), "learnin_rate"),
        (("runs", 0), "method"),
    ],
)
def test_an_unknown_key_is_named_with_the_file_and_the_known_ones(
    path: tuple[Any, ...], key: str
) -> None:
    data = smoke()
    place: Any = data
    for step in path:
        place = place[step]
    place[key] = 1
    with pytest.raises(BenchmarkError) as error:
        parsed(data)
    message = str(error.value)
    assert f"'{key}'" in message
    assert "mine.yaml" in message
    assert "known keys" in message


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"seeds": []}, "seeds"),
        ({"seeds": [1, 1]}, "seeds"),
        ({"seeds": "0"}, "seeds: Input should be a valid array, found '0'"),
        ({"evaluation": {"episodes": 0}}, "episodes"),
        ({"evaluation": {"episodes": True}}, "episodes: .* valid integer, found True"),
        ({"evaluation": {"episodes": 1, "noise": [0.1]}}, "noise"),
        ({"evaluation": {"episodes": 1, "noise": [0.0, 0.0]}}, "noise: must be some, and differ"),
        ({"planner": {"time_limit": -1}}, "time_limit: .* greater than 0, found -1"),
        ({"planner": {"node_limit": 0}}, "node_limit: .* greater than 0, found 0"),
        ({"design": {"runs": 0}}, "runs: .* greater than 0, found 0"),
        ({"checkpoint_seconds": "soon"}, "checkpoint_seconds"),
        ({"checkpoint_seconds": -1}, "seconds: .* greater than or equal to 0, found -1"),
        (safe(curriculum={"window": -3}), "window: .* greater than 0, found -3"),
        (safe(curriculum={"threshold": 75}), "threshold: .* less than or equal to 1, found 75"),
        (safe(hyperparameters={"updates_per_step": -1}), "updates_per_step: .* greater than 0"),
        (safe(hyperparameters={"epsilon_start": 7}), "epsilon_start: .* less than or equal to 1"),
        (safe(hyperparameters={"epsilon_steps": -5}), "epsilon_steps: .* greater than 0"),
        (safe(ppo={"n_epochs": 0}), "n_epochs: .* greater than 0, found 0"),
        ({"name": "other"}, "name"),
        ({"geometries": {"mine": {"base_radius": 0.1, "proximal_length": 0.1}}}, "mine"),
        ({"geometries": {"mine": SMALL_BASE}}, "lambda3"),
        ({"tracks": {"mine": {"base": "sfae"}}}, "unknown base 'sfae'"),
        (mine(base="vdn", team="qmix"), r"team: Input should be .*'vdn'.*, found 'qmix'"),
        (unsure(base_position_error=0.003, base_tlit_error=0.0), "base_tlit_error"),
        (unsure(base_position_error=1.0), "base_position_error"),
        (unsure(observation_noise=0.01), "must have a base_position_error"),
    ],
)
def test_an_impossible_value_is_refused(change: dict[str, Any], word: str) -> None:
    with pytest.raises(BenchmarkError, match=word):
        parsed(smoke() | change)


def test_a_number_that_yaml_reads_as_text_is_one_among_arguments_too() -> None:
    data: dict[str, Any] = {
        "tracks": {"safe": {"methods": {"dqn": {"tau": "5e-3", "policy": "MlpPolicy"}}}}
    }
    dqn = smoke_preset(**data).tracks["safe"].methods["dqn"]
    assert dqn == {"tau": 0.005, "policy": "MlpPolicy"}


@pytest.mark.parametrize(
    ("method", "track", "more", "word"),
    [
        ("ppo", "safe", {}, "unknown method 'ppo'"),
        ("rainbow", "best", {}, "unknown track 'best'"),
        ("rainbow", None, {}, "needs a track"),
        ("greedy", None, {}, "needs a track"),
        ("optimum", "safe", {}, "takes no track 'safe'"),
        ("rrt_lattice", {"base": "uncertain"}, {}, "takes no track 'mine'"),
        ("nominal_plan", None, {}, "needs a track with sim_to_real"),
        ("greedy", {"base": "uncertain", "sim_to_real": {"base_position_error": 0.0025}}, {},
         "errors lack 2.5 mm"),
        ("dqn", "safe", {"ablations": ["no_noisy"]}, "only rainbow"),
        ("rainbow", "safe", {"ablations": ["no_luck"]}, "no_luck"),
        ("optimum", None, {"geometries": ["round"]}, "unknown geometry 'round'"),
        # teams
        ("rainbow", {"base": "vdn", "mask_visited": 64}, {}, "mask_visited = 64 .* leave it out"),
        ("rainbow", {"base": "shared", "mask_refused": True}, {}, "mask_refused = True .* leave"),
        ("rainbow", {"base": "uncertain", "mask_visited": 0, "mask_refused": False,
                     "team": "central"}, {}, "sim_to_real = .* leave it out"),
        ("rainbow", {"base": "central", "sight": True}, {}, "sees both robots: leave out sight"),
        ("rainbow", {"base": "safe", "sight": True}, {}, "name it, or leave it out"),
        ("rainbow", {"base": "shared", "hyperparameters": {"n_envs": 7}}, {}, "n_envs = 7 is odd"),
        ("dqn", {"base": "vdn"}, {}, "method 'dqn' has no form for a team; known: greedy, rainbow"),
        ("lookahead", {"base": "vdn"}, {}, "method 'lookahead' has no form for a team"),
    ],
)  # fmt: skip
def test_an_impossible_cell_is_refused(
    method: str, track: str | dict[str, Any] | None, more: dict[str, Any], word: str
) -> None:
    own = isinstance(track, dict)
    group = {"methods": [method], **({"tracks": ["mine" if own else track]} if track else {})}
    tracks = smoke()["tracks"] | ({"mine": track} if own else {})
    preset = parsed(smoke() | {"tracks": tracks, "runs": [group | more]})
    with pytest.raises(BenchmarkError, match=word):
        expand(preset)


def test_teams_share_one_setting_and_see_as_many_ticks() -> None:
    tracks = load_preset("team").tracks
    central = dataclasses.replace(tracks["central"], team=None, controls=Controls())
    assert dataclasses.replace(central, description="") == dataclasses.replace(
        tracks["in_turn"], description=""
    )
    for track in tracks.values():
        h, first = track.hyperparameters, central.hyperparameters
        per_tick: dict[str, Any] = {
            "n_envs": h.n_envs // track.rows,
            "updates_per_step": first.updates_per_step,
        }
        per_tick |= {
            name: getattr(h, name) // track.rows for name in ("learning_starts", "epsilon_steps")
        }
        assert dataclasses.replace(h, **per_tick) == first
        assert track.timesteps == track.rows * central.timesteps
        assert h.gradient_steps == first.gradient_steps


def test_a_geometry_of_ones_own_reaches_the_runs_settings() -> None:
    sizes = {"base_radius": 0.18, "proximal_length": 0.1, "platform_radius": 0.11}
    runs = [{"methods": ["optimum"], "geometries": ["mine"]}]
    preset = smoke_preset(geometries={"mine": sizes}, runs=runs)
    (cell,) = expand(preset)
    assert settings(preset, cell)["dimensions"] == sizes


def test_unknown_presets_and_cells_list_the_known_ones() -> None:
    with pytest.raises(BenchmarkError, match=r"grid, .*paper, .*shielded, smoke, support, team"):
        load_preset("fast")
    with pytest.raises(BenchmarkError, match="unknown preset '_tracks'"):
        load_preset("_tracks")
    with pytest.raises(BenchmarkError, match="rainbow-optimized-safe-s0"):
        Insertion(load_preset("smoke")).find("rainbow-s9")


def test_each_ablation_switches_one_component_and_no_other() -> None:
    preset = load_preset("quick")
    for cell in expand(preset):
        if cell.method == "rainbow":
            switches = settings(preset, cell)["switches"]
            assert len(switches) == {"full": 0, "double_dueling": 4, "none": 6}.get(
                cell.ablation, 1
            )


def test_a_track_may_vary_another_and_that_one_a_third() -> None:
    tracks = load_preset("cut").tracks
    safe, memory, uncertain = (tracks[name] for name in ("safe", "memory", "uncertain"))
    said: dict[str, Any] = {"description": "", "mask_visited": 64, "controls": memory.controls}
    assert dataclasses.replace(safe, **said) == dataclasses.replace(memory, **said)
    said |= {"mask_refused": True, "sim_to_real": uncertain.sim_to_real}
    said |= {"controls": uncertain.controls}
    assert dataclasses.replace(memory, **said) == dataclasses.replace(uncertain, **said)


def test_tracks_change_what_they_are_named_for() -> None:
    tracks = load_preset("cut").tracks
    printed, reward = (load_preset("paper").tracks[name] for name in ("printed", "repaired"))
    said: dict[str, Any] = {"description": "", "reward": "", "reward_kwargs": {}}
    assert dataclasses.replace(printed, **said) == dataclasses.replace(reward, **said)
    assert (reward.reward, reward.mask_singularities, reward.mask_visited) == ("progress", False, 0)
    assert tracks["safe"].mask_singularities
    assert tracks["safe"].mask_visited == 0
    assert not tracks["safe"].mask_refused
    nominal: dict[str, Any] = {"description": "", "train_nominal": True}
    uncertain = dataclasses.replace(tracks["uncertain"], **nominal)
    assert uncertain == dataclasses.replace(tracks["uncertain_nominal"], **nominal)


def test_the_test_starts_are_the_paper_presets_alone() -> None:
    presets = [preset for preset in map(load, preset_names()) if isinstance(preset, Preset)]
    streams = {preset.name: preset.evaluation.stream for preset in presets}
    assert {name for name, stream in streams.items() if stream == "final"} == {"paper"}
    assert {name for name, stream in streams.items() if stream == "test"} == {"cut"}
    assert min(load_preset("grid").seeds) > max(load_preset("cut").seeds)


def test_runs_from_before_the_newer_keys_are_still_what_the_preset_says() -> None:
    """Printed runs, and the planners', are hours of work that no new key may make void."""
    preset = load_preset("cut")
    runs = PRESETS.parents[2] / "results" / "cut" / "runs"
    seen = 0
    for cell in expand(preset):
        path = runs / cell.id / "config.yaml"
        if path.is_file() and (cell.track == "printed" or not cell.track):
            stored = yaml.safe_load(path.read_text(encoding="utf-8"))
            assert stored == json.loads(json.dumps(settings(preset, cell))), cell.id
            seen += cell.learns and cell.track == "printed"
    assert seen == 10


def test_what_has_no_bearing_on_a_control_is_not_among_its_settings() -> None:
    preset = load_preset("cut")
    by_id = {cell.id: settings(preset, cell) for cell in expand(preset)}
    track = by_id["greedy-optimized-uncertain-s0"]["track"]
    assert "hyperparameters" not in track
    assert set(track["controls"]) == {f"{method}_angle" for method in CONTROLS[1:]}
    assert "controls" not in by_id["rainbow-optimized-uncertain-s0"]["track"]
    assert "errors" not in by_id["greedy-optimized-safe-s0"]["evaluation"]
    assert 3.0 in by_id["optimum-optimized-uncertain-s0"]["evaluation"]["errors"]


def test_bytes_that_are_no_text_are_one_line(tmp_path: Path) -> None:
    path = tmp_path / "bin.yaml"
    for content in (b"\xff\xfe\x00", b"seeds: [0\nruns"):
        path.write_bytes(content)
        with pytest.raises(BenchmarkError, match="not valid YAML") as caught:
            load_preset(str(path))
        assert "\n" not in str(caught.value)


def test_a_file_in_the_place_of_the_results_is_one_line(
    tmp_path: Path, refused: Callable[..., str]
) -> None:
    (tmp_path / "file").write_text("")
    words = ["run", "--preset", "smoke", "--results", str(tmp_path / "file")]
    assert "name another place" in refused(*words)


@pytest.mark.parametrize("words", [["rainbow", "--steps", "-1"], ["env", "--starts", "0"]])
def test_speed_of_nothing_is_refused(words: list[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["study", f"speed-{words[0]}", *words[1:]])
    assert caught.value.code == 2


SAFE = {"mask_singularities": True}
VISITED = {**SAFE, "mask_visited": 64}


@pytest.mark.parametrize(
    ("method", "track", "masks", "memory"),
    [
        ("rainbow", {}, "paper's", "none"),
        ("rainbow", SAFE, "safe", "none"),
        ("greedy", VISITED, "safe", "64 configurations"),
        ("maskable_ppo", {**VISITED, "mask_refused": True}, "safe",
         "64 configurations, refused moves"),
        ("random", {"mask_refused": True}, "paper's", "refused moves"),
        ("dqn", VISITED, "none", "none"),
        ("dqn", {"observation": "markov"}, "none", "filled holes and time"),
        ("optimum", None, "none", "its plan"),
        ("plan_search", VISITED, "none", "its plan"),
    ],
)  # fmt: skip
def test_who_has_a_memory_says_so(
    method: str, track: dict[str, Any] | None, masks: str, memory: str
) -> None:
    result = knowledge(method, track)
    assert (result.masks, result.memory) == (masks, memory)


def test_only_what_remembers_nothing_claims_so() -> None:
    """The settings of every cell are enough to say it; safe and printed have no memory at all."""
    preset = load_preset("cut")
    for cell in expand(preset):
        if cell.method not in METHODS:
            continue
        memory = knowledge(cell.method, settings(preset, cell).get("track")).memory
        forgetful = cell.track in ("printed", "reward", "safe") or cell.method == "dqn"
        assert (memory == "none") == forgetful, cell.id
