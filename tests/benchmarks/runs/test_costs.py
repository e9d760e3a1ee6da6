"""What ``plan`` says of cost: measured where something like it ran, and how long it takes."""

import re
from pathlib import Path
from typing import Any

import pytest

from benchmarks.errors import BenchmarkError
from benchmarks.protocol.plan import expand, settings, units_of
from benchmarks.protocol.presets import Preset
from benchmarks.runs.costs import (
    GUESSED_RATE,
    STARTING,
    Cost,
    costs,
    duration,
    rate,
    wall_seconds,
)
from benchmarks.runs.store import Store
from benchmarks.studies.insertion import Insertion
from tests.benchmarks.conftest import Command
from tests.benchmarks.smoke import smoke_preset


def make(name: str, timesteps: int, **more: Any) -> Preset:
    return smoke_preset(name, track={"timesteps": timesteps}, **more)


def complete(store: Store, preset: Preset, method: str, seconds: float) -> None:
    cell = next(cell for cell in expand(preset) if cell.method == method)
    run = store.run(cell.id)
    run.begin(settings(preset, cell))
    run.write_meta({"wall_seconds": seconds})


def test_cost_comes_from_the_nearest_runs(tmp_path: Path) -> None:
    preset, other = make("mine", 1000, seeds=[0, 1]), make("other", 500)
    store = Store.open(tmp_path, "mine", create=True)
    elsewhere = Store.open(tmp_path, "other", create=True)
    complete(store, preset, "rainbow", 20.0)
    complete(elsewhere, other, "rainbow", 999.0)  # the preset's own run counts
    complete(elsewhere, other, "dqn", 5.0)
    for damaged in ({}, {"cell": {"method": "dqn"}, "track": []}, {"track": {"timesteps": "x"}}):
        run = elsewhere.run(f"damaged-{len(damaged)}")  # counts for nothing
        run.begin(settings(other, expand(other)[1]) | damaged)
        run.write_meta({"wall_seconds": 5.0 if damaged else "x"})
    store.run("dqn-optimized-safe-s1").write_progress(0.25, "")
    planned = {cost.id: cost for cost in costs(Insertion(preset), store, [elsewhere])}
    assert planned["rainbow-optimized-safe-s0"].state == "complete"
    assert planned["rainbow-optimized-safe-s0"].seconds == 20.0
    assert planned["rainbow-optimized-safe-s1"].seconds == pytest.approx(STARTING + 20.0)
    # of twice the steps
    assert planned["dqn-optimized-safe-s0"].seconds == pytest.approx(STARTING + 10.0)
    assert planned["dqn-optimized-safe-s1"].seconds == pytest.approx(STARTING + 7.5)
    assert planned["dqn-optimized-safe-s1"].state == "25 %"
    guessed = planned["optimum-optimized-s0"]
    assert guessed.guessed
    optimum = next(settings(preset, cell) for cell in expand(preset) if cell.id == guessed.id)
    assert guessed.seconds == pytest.approx(STARTING + GUESSED_RATE * units_of(optimum))
    with pytest.raises(BenchmarkError, match="timesteps: 1000 -> 2000"):
        costs(Insertion(make("mine", 2000)), store)


def test_the_nearest_runs_are_those_that_have_most_in_common() -> None:
    ran = [(("dqn", "4", "full"), 6.0, 1), (("dqn", "4", "none"), 1.0, 1), (("dqn", "8"), 2.0, 9)]
    for kind, wanted in (
        (("dqn", "4", "full"), 6.0),
        (("dqn", "4", "no_noisy"), 3.5),
        (("dqn", "1", "full"), 9.0 / 11.0),  # a long run weighs more
        (("ppo", "4", "full"), None),
    ):
        assert rate(kind, ran) == wanted


def test_time_left_is_that_of_processes_taking_the_next_run() -> None:
    planned = [Cost("a", False, 0.0, seconds, False) for seconds in (5.0, 4.0, 3.0, 2.0)]
    planned.append(Cost("a", True, 1.0, 100.0, False))
    assert wall_seconds(planned, 1) == 14.0
    assert wall_seconds(planned, 2) == 7.0  # 5 and 2 beside 4 and 3
    assert wall_seconds(planned, 9) == 5.0


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.4, "0 s"),
        (89.0, "89 s"),
        (90.0, "2 min"),
        (5400.0, "1.5 h"),
        (172_000.0, "47.8 h"),
        (180_000.0, "2.1 days"),
    ],
)
def test_durations_are_said_as_people_say_them(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_plan_says_what_is_left(tmp_path: Path, done: Command) -> None:
    preset = make("smoke", 480)
    words = ["plan", "--preset", "smoke", "--results", str(tmp_path), "--jobs"]
    out = done(*words, "2")
    assert "5 to run" in out
    assert "with 2 processes; a guess for 5 cells" in out
    assert list(tmp_path.iterdir()) == []  # a plan writes nothing
    complete(Store.open(tmp_path, "smoke", create=True), preset, "dqn", 60.0)
    out = done(*words, "1")
    assert "4 to run" in out
    assert re.search(r"dqn-optimized-safe-s0 +│ complete +│ 60 s +│ +│", out)  # took, not left
