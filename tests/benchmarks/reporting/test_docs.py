"""docs/presets.md has every key of a preset with its default, docs/benchmarks.md real commands."""

from __future__ import annotations

import dataclasses
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import yaml

from benchmarks.cli import parser
from benchmarks.protocol import presets
from benchmarks.protocol.plan import ABLATIONS, GEOMETRIES, METHODS, expand
from benchmarks.runs.callbacks import ROWS
from benchmarks.runs.ray_backend import RETRIES
from benchmarks.studies import catalogue

DOCS = Path(__file__).resolve().parents[3] / "docs"
PAGE = (DOCS / "benchmarks.md").read_text("utf-8")
PRESETS = (DOCS / "presets.md").read_text("utf-8")
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
        if (
            default is dataclasses.MISSING
            or dataclasses.is_dataclass(default)
            or default in ({}, [])
        ):
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
    preset = presets.parse_preset(yaml.safe_load(example), "example", "example")
    # two tracks and two ablations, a control, four on the machine, the optimum, for three seeds
    assert len(expand(preset)) == 3 * (2 * 2 + 1 + 4 + 1)
    assert preset.tracks["patient"].hyperparameters.gamma == 0.97


def test_every_command_is_one() -> None:
    commands = re.findall(r"(?:^ {4}|`)python -m benchmarks ([^`\n]*)", PAGE, re.MULTILINE)
    assert len(commands) >= 10
    for command in commands:
        words = shlex.split(command, comments=True)
        if words[:1] == ["study"] and words[1] in catalogue.STUDIES:
            catalogue.study(words[1]).parser().parse_args(words[2:])
        elif words[:1] != ["study"]:
            parser().parse_args(words)


def test_the_numbers_in_the_text_are_those_of_the_code() -> None:
    assert f"at most {ROWS + 1} rows" in PAGE
    assert RETRIES + 1 == 4
    assert "lost four times in a row" in PAGE
