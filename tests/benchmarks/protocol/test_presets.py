"""Presets are strict: whatever a file gets wrong is named, with the file and what is known."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from benchmarks.cli import main
from benchmarks.errors import BenchmarkError
from benchmarks.protocol import plan
from benchmarks.protocol.labels import knowledge
from benchmarks.protocol.plan import checkpoint_bytes, expand, settings, units_of
from benchmarks.protocol.presets import Preset, load, load_preset, load_suite, preset_names
from benchmarks.studies.insertion import Insertion
from tests.benchmarks.smoke import parsed, smoke, smoke_file, smoke_preset

SIZES = {"base_radius": 0.18, "proximal_length": 0.1, "platform_radius": 0.11}
SMALL_BASE = {"base_radius": 0.1, "proximal_length": 0.1, "platform_radius": 0.2}


def safe(**track: Any) -> dict[str, Any]:
    return {"tracks": {"safe": track}}


def mine(**track: Any) -> dict[str, Any]:
    return {"tracks": {"mine": track}}


def noisy(level: float) -> dict[str, Any]:
    return {"evaluation": {"episodes": 1, "noise": [0.0, level]}}


def unsure(**knobs: float) -> dict[str, Any]:
    """On a machine with these errors."""
    return mine(base="safe", sim_to_real=knobs)


@pytest.mark.parametrize("name", preset_names())
def test_shipped_presets_expand_to_cells_with_unique_folders(name: str) -> None:
    cells = expand(load(name))
    assert len({cell.id for cell in cells}) == len(cells) > 0


def test_a_group_of_runs_may_have_seeds_of_its_own() -> None:
    runs = [{"methods": ["greedy"], "tracks": ["safe"], "seeds": [7]}, {"methods": ["optimum"]}]
    cells = expand(smoke_preset(seeds=[0, 1], runs=runs, design=None))
    assert {(c.method, c.seed) for c in cells} == {("greedy", 7), ("optimum", 0), ("optimum", 1)}


def test_the_longest_runs_begin_first_and_of_public_tasks_seed_by_seed() -> None:
    first = [(True, 0)] * 2 + [(True, 1)] * 2 + [(False, 0)] * 3 + [(False, 1)] * 3
    assert [(cell.learns, cell.seed) for cell in expand(smoke_preset(seeds=[0, 1]))] == first
    suite = dataclasses.replace(load_suite("tiny"), seeds=[0, 1])
    costs = [(cell.seed, -units_of(settings(suite, cell))) for cell in expand(suite)]
    assert costs == sorted(costs)
    assert len({cost for _, cost in costs}) > 2
    # each error is a level of its own
    whole = load_preset("cut")
    ran = [units_of(settings(whole, c)) for c in expand(whole) if c.method == "greedy"]
    assert max(ran) == len(whole.evaluation.errors) * min(ran)


def test_a_checkpoint_has_room_for_two_stacks_of_frames_of_a_transition() -> None:
    preset = load_suite("atari100k")
    cell = next(cell for cell in expand(preset) if cell.learns)
    size = settings(preset, cell)["arguments"]["buffer_size"]
    assert checkpoint_bytes(preset, cell) > size * 2 * 4 * 84 * 84


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


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"sedes": [0]}, r"^mine.yaml: unknown key 'sedes'; known keys: check(?!.*\bname\b)"),
        ({"runs": [{"method": []}]}, r"mine.yaml: runs\[0\]: unknown key 'method'; known keys"),
        (safe(hyperparameters={"learnin_rate": 1.0}), "unknown key 'learnin_rate'"),
        ({"seeds": []}, "seeds"),
        ({"seeds": [1, 1]}, "seeds"),
        ({"seeds": "0"}, "seeds: Input should be a valid array, found '0'"),
        ({"evaluation": {"episodes": True}}, "episodes: .* valid integer, found True"),
        ({"evaluation": {"episodes": 1, "noise": [0.1]}}, "noise"),
        (noisy(0.0), "noise: needs one value or more"),
        (noisy(float("nan")), "noise.* finite number, found"),
        (noisy(2.0), r"noise\[1\]: .* less than or equal to 1, found 2.0"),
        ({"planner": {"time_limit": -1}}, "time_limit: .* greater than 0, found -1"),
        ({"checkpoint_seconds": "soon"}, "checkpoint_seconds"),
        ({"checkpoint_seconds": -1}, "seconds: .* greater than or equal to 0, found -1"),
        (safe(curriculum={"threshold": 75}), "threshold: .* less than or equal to 1, found 75"),
        ({"name": "other"}, "name"),
        ({"geometries": {"mine": {"base_radius": 0.1, "proximal_length": 0.1}}}, "mine"),
        ({"geometries": {"mine": SMALL_BASE}}, "lambda3"),
        ({"tracks": {"mine": {"base": "sfae"}}}, "unknown base 'sfae'"),
        ({"tracks": {"mine": {"base": ["safe"]}}}, r"unknown base '\['safe'\]'"),
        (mine(base="vdn", team="qmix"), r"team: Input should be .*'vdn'.*, found 'qmix'"),
        (unsure(base_position_error=0.003, base_tlit_error=0.0), "base_tlit_error"),
        (unsure(base_position_error=1.0), "base_position_error"),
        (unsure(observation_noise=0.01), "must have a base_position_error"),
    ],
)
def test_an_impossible_value_is_refused(change: dict[str, Any], word: str) -> None:
    with pytest.raises(BenchmarkError, match=word):
        parsed(smoke() | change)


def test_a_number_that_yaml_reads_as_text_is_one_among_arguments_too(tmp_path: Path) -> None:
    changes = {"methods": {"dqn": {"tau": "5e-3", "policy": "MlpPolicy"}}}
    machine = {"base_position_error": "3e-3"}
    path = smoke_file(tmp_path, "mine", **safe(**changes, sim_to_real=machine))
    assert "tau: 5e-3\n" in path.read_text(encoding="utf-8")
    preset = load_preset(str(path))
    assert preset.tracks["safe"].sim_to_real == {"base_position_error": 0.003}
    assert preset.tracks["safe"].methods["dqn"] == {"tau": 0.005, "policy": "MlpPolicy"}


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
        ("greedy", {"base": "uncertain", "sim_to_real": {"base_tilt_error": 0.1}}, {},
         "errors: 8 mm on track 'mine': SimToReal.base_tilt_error = 0.26.*: .* at most 0.2"),
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


def test_a_learner_of_ones_own_takes_a_team_as_one_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    def made(track: str) -> Preset:
        group = {"methods": ["dqn"], "tracks": [track]}
        return parsed(smoke() | {"tracks": {track: None}, "runs": [group]})

    monkeypatch.setattr(plan, "OF_TEAMS", (*plan.OF_TEAMS, "dqn"))
    assert expand(made("central"))
    for track in ("vdn", "independent"):
        with pytest.raises(BenchmarkError, match="its networks are Rainbow's, not of 'dqn'"):
            expand(made(track))


@pytest.mark.parametrize(
    ("tracks", "geometries", "words"),
    [
        (["a/b"], ["optimized"], "cell 'greedy-optimized-a/b-s0' is no name of a folder"),
        (["z", "y-z"], ["x", "x-y"], "cell 'greedy-x-y-z-s0' stands for two"),
    ],
)
def test_names_that_make_no_folder_or_one_for_two_are_refused(
    tracks: list[str], geometries: list[str], words: str
) -> None:
    preset = smoke_preset(
        tracks={name: {"base": "safe"} for name in tracks},
        geometries=dict.fromkeys(geometries, SIZES),
        runs=[{"methods": ["greedy"], "tracks": tracks, "geometries": geometries}],
    )
    with pytest.raises(BenchmarkError, match=words):
        expand(preset)


def test_a_geometry_of_ones_own_reaches_the_runs_settings() -> None:
    runs = [{"methods": ["optimum"], "geometries": ["mine"]}]
    preset = smoke_preset(geometries={"mine": SIZES}, runs=runs)
    (cell,) = expand(preset)
    assert settings(preset, cell)["dimensions"] == SIZES


def test_a_runs_settings_are_of_its_own_method_alone() -> None:
    preset = smoke_preset(track={"methods": {"dqn": {"tau": 0.005}}})
    stored = {c.method: settings(preset, c).get("track", {}).get("methods") for c in expand(preset)}
    assert stored.pop("dqn") == {"dqn": {"tau": 0.005}}
    assert set(stored.values()) == {None}


def test_what_is_not_there_is_an_error_that_lists_what_is(tmp_path: Path) -> None:
    with pytest.raises(BenchmarkError, match=r"grid, .*paper, .*shielded, smoke, support, team"):
        load_preset("fast")
    with pytest.raises(BenchmarkError, match="unknown preset '_tracks'"):
        load_preset("_tracks")
    with pytest.raises(BenchmarkError, match="rainbow-optimized-safe-s0"):
        Insertion(load_preset("smoke")).find("rainbow-s9")
    with pytest.raises(BenchmarkError, match="the package has a preset 'smoke'"):
        load(str(smoke_file(tmp_path, "smoke")))
    with pytest.raises(BenchmarkError, match="preset 'empty' holds no run"):
        expand(smoke_preset("empty", runs=[]))


def test_the_test_starts_are_the_paper_presets_alone() -> None:
    presets = [preset for preset in map(load, preset_names()) if isinstance(preset, Preset)]
    streams = {preset.name: preset.evaluation.stream for preset in presets}
    assert {name for name, stream in streams.items() if stream == "final"} == {"paper"}
    assert {name for name, stream in streams.items() if stream == "test"} == {"cut"}
    assert min(load_preset("grid").seeds) > max(load_preset("cut").seeds)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"seeds: [0]\nseeds: [1]\n", "key 'seeds' is given twice"),
        (b"runs: &a [*a]\nseeds: [0]\nevaluation: {episodes: 1}\ndescription: x\n", "mine.yaml: "),
        (b"\xff\xfe\x00", "not valid YAML"),
        (b"seeds: [0\nruns", "not valid YAML"),
    ],
)
def test_a_file_that_means_two_things_or_nothing_is_one_line(
    tmp_path: Path, content: bytes, words: str
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_bytes(content)
    with pytest.raises(BenchmarkError, match=words) as caught:
        load_preset(str(path))
    assert "\n" not in str(caught.value)


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
        ("mine", {"algorithm": "mine:plan", "sha256": "", **SAFE}, "safe", "its plan"),
    ],
)  # fmt: skip
def test_who_has_a_memory_says_so(
    method: str, track: dict[str, Any] | None, masks: str, memory: str
) -> None:
    result = knowledge(method, track)
    assert (result.masks, result.memory) == (masks, memory)
