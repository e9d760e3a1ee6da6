"""Pages: every key of a preset with its default, real commands, includes, the gallery."""

import dataclasses
import math
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from benchmarks.cli import parser
from benchmarks.errors import BenchmarkError
from benchmarks.protocol import presets
from benchmarks.protocol.plan import ABLATIONS, GEOMETRIES, METHODS, expand
from benchmarks.reporting import blocks
from benchmarks.runs.callbacks import ROWS
from benchmarks.runs.ray_backend import RETRIES
from benchmarks.runs.store import RunFolder, write_text
from benchmarks.studies import catalogue
from coop_env import CoopInsertionEnv
from tests.benchmarks.smoke import parsed
from tests.process import ROOT, tracked

PAGE = (ROOT / "docs" / "benchmarks.md").read_text("utf-8")
PRESETS = (ROOT / "docs" / "presets.md").read_text("utf-8")
STORE = (ROOT / "results" / "README.md").read_text("utf-8")
GALLERY = (ROOT / "docs" / "gallery.md").read_text("utf-8")
INCLUDE = "<!-- include:begin results/a/b.md (written by: x) -->\n<!-- include:end -->\n"
SECTIONS: dict[str, type] = {
    "Preset": presets.Preset,
    "Group of runs": presets.RunGroup,
    "Evaluation": presets.Evaluation,
    "Track": presets.Track,
    "Curriculum": presets.Curriculum,
    "Hyperparameters": presets.Hyperparameters,
    "PPO": presets.PPOSettings,
    "Controls": presets.Controls,
    "Planner": presets.PlannerSettings,
    "Design": presets.DesignSettings,
}


def section(title: str) -> str:
    return re.split(r"^#+ ", PRESETS.split(f"\n## {title}\n")[1], maxsplit=1, flags=re.MULTILINE)[0]


@pytest.mark.parametrize("title", sorted(SECTIONS))
def test_every_key_is_there_with_its_default(title: str) -> None:
    rows = re.findall(r"^\| `(\w+)` \|(.*?)\| .+ \|$", section(title), re.MULTILINE)
    own = {*SECTIONS[title].__annotations__} - {"name"}  # what a class adds to the one it is of
    fields = {f.name: f for f in dataclasses.fields(SECTIONS[title]) if f.name in own}
    assert {key for key, _ in rows} == set(fields)
    for key, cell in rows:
        field, text = fields[key], cell.strip()
        default: Any = field.default
        if field.default_factory is not dataclasses.MISSING:
            default = field.default_factory()
        if dataclasses.is_dataclass(default) or default in (dataclasses.MISSING, {}, []):
            assert text == "", key
        elif isinstance(default, str):
            assert text == default
        else:
            shown = yaml.safe_load("null" if text == "none" else text)
            assert (float(shown) if isinstance(shown, str) else shown) == default, key


def test_every_name_is_there() -> None:
    group = section("Group of runs")
    for name in (*METHODS, *ABLATIONS, *GEOMETRIES):
        assert f"`{name}`" in group, name


def test_the_example_is_a_preset() -> None:
    (example,) = re.findall(r"```yaml\n(.*?)```", PRESETS, re.DOTALL)
    preset = parsed(yaml.safe_load(example))
    # two tracks and two ablations, a control, four on the machine, the optimum, for three seeds
    assert len(expand(preset)) == 3 * (2 * 2 + 1 + 4 + 1)
    assert preset.tracks["patient"].hyperparameters.gamma == 0.97


@pytest.mark.parametrize(("page", "least"), [(PAGE, 10), (GALLERY, 8)], ids=["page", "gallery"])
def test_every_command_is_one(page: str, least: int) -> None:
    commands = re.findall(r"(?:^ {4}|`)python -m benchmarks ([^`\n]*)", page, re.MULTILINE)
    assert len(commands) >= least
    for command in commands:
        argv = shlex.split(command, comments=True)
        if argv[0] == "study":
            catalogue.study(argv[1]).parser().parse_args(argv[2:])
        else:
            parser().parse_args(argv)


def test_the_numbers_in_the_text_are_those_of_the_code() -> None:
    assert f"at most {ROWS + 1} rows" in STORE
    assert RETRIES + 1 == 4
    assert "lost four times in a row" in PAGE


def test_an_include_is_filled_and_filled_again(tmp_path: Path) -> None:
    results, page = tmp_path / "results", tmp_path / "docs" / "page.md"
    write_text(results / "a" / "b.md", "| 95 % |\n")
    write_text(page, f"# A page\n\n{INCLUDE}\nAnd on.\n")
    known = {"include": blocks.include(results)}
    assert blocks.rewrite(results, known) == [page]
    filled = page.read_text(encoding="utf-8")
    assert "\n\n| 95 % |\n\n" in filled
    assert filled.startswith("# A page\n")
    assert filled.endswith("\n\nAnd on.\n")
    assert blocks.rewrite(results, known) == []
    assert [problems for _, problems in blocks.check(results, known)] == [[]]
    write_text(results / "a" / "b.md", "| 96 % |\n")
    ((_, (problem,)),) = blocks.check(results, known)
    assert problem.startswith(f"{page} differs from stored data (line 5: stored '| 95 % |'")
    (results / "a" / "b.md").unlink()
    gone = f"{page}: results/a/b.md is no file of"
    ((_, (problem,)),) = blocks.check(results, known)
    assert problem.startswith(gone)
    with pytest.raises(BenchmarkError, match=f"^{gone}"):
        blocks.rewrite(results, known)


@pytest.mark.parametrize("name", ["results/audit/none.md", "results/../page.md", "page.md"])
def test_an_include_of_what_is_not_there_is_named(name: str) -> None:
    with pytest.raises(BenchmarkError, match="is no file of"):
        blocks.include(ROOT / "results")(name)


def test_the_environments_docstring_says_its_bounds_and_steps() -> None:
    envs = [CoopInsertionEnv(observation="markov", normalize=scaled) for scaled in (False, True)]
    said_of = blocks.docstring(CoopInsertionEnv)
    named = {"pi/4": math.pi / 4, "-pi/4": -math.pi / 4, "0.2 `max_moves`": 60.0}
    bounds = []
    for row in re.findall(r"^\| (\d.*) \|$", said_of("Observation Space"), re.MULTILINE):
        fields, _, *ends = row.split(" | ")
        pair = [named.get(end) or float(end.split()[0]) for end in ends]
        bounds += [pair] * (int(fields.split()[-1]) - int(fields.split()[0].strip(",")) + 1)
    low, high = np.array(bounds).T
    for seed in range(20):
        plain, scaled = (env.reset(seed=seed, options={"filled": [3]})[0] for env in envs)
        assert scaled == pytest.approx(((plain - low) / (high - low)).clip(0.0, 1.0), abs=1e-6)
    steps = re.findall(r"(\d\.\d+) (?:m|rad) \|", said_of("Action Space"))
    assert [*map(float, steps)] == list(envs[0].task.steps)
    with pytest.raises(BenchmarkError, match="no section 'Dessert'"):
        said_of("Dessert")


def test_a_block_without_its_data_stays() -> None:
    def missing(_: str) -> str:
        raise KeyError

    page = "a\n<!-- one:begin x -->\nold\n<!-- one:end -->\nb\n"
    assert blocks.render(page, {"one": missing}) == page
    assert "\n\nx\n\n" in blocks.render(page, {"one": lambda argument: argument})


def test_every_committed_picture_is_shown() -> None:
    shown = set(re.findall(r"!\[\]\(\.\./(results/[^)]+)\)", GALLERY))
    assert {*tracked("results/*.png", "results/*.gif")} - shown == set()


def test_a_block_says_of_which_runs_it_is(tmp_path: Path) -> None:
    runs = [RunFolder(tmp_path / str(number)) for number in range(3)]
    for number, run in enumerate(runs):
        made_by = {"commit": f"{number}23456789abc", "dirty": number == 2}
        machine = {"machine": {"processor": f"P{number % 2}"}}
        run.path.mkdir()
        run.write_meta({**made_by, **machine, "cpu_seconds": 120.0, "wall_seconds": 1.0})
    assert blocks.provenance("p", []) == "Preset `p`: no run is complete."
    assert blocks.provenance("p", runs[:2]) == (
        "Preset `p`: 2 runs, 4 CPU minutes, at commit 023456789, 123456789, on P0; P1."
    )
    assert blocks.provenance("p", [*runs[1:], runs[2]], missing=4, controls=1) == (
        "Preset `p`: 2 runs and 1 of controls (4 are missing), 6 CPU minutes, at commit "
        "123456789, 223456789 with uncommitted changes, on P0; P1."
    )
    assert "at 3 commits with uncommitted changes" in blocks.provenance("p", runs)
