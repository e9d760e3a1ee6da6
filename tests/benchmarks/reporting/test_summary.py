"""The sentences above the tables say what the stored runs say, and nothing without runs."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest

from benchmarks.protocol.plan import ABLATIONS
from benchmarks.reporting.pages.summary import sentences
from benchmarks.reporting.results import Results, tail_mean
from benchmarks.runs.store import Store
from tests.benchmarks import fabricated_store
from tests.benchmarks.fabricated_store import make_store


def test_sentences_follow_the_numbers(tmp_path: Path) -> None:
    told = sentences(Results(make_store(tmp_path, [0, 1], "paper")))
    assert len(told) == 5
    ceiling, rivals, printed, components, geometry = told
    # 9 and 8 of 10 solved by Rainbow, 10 and 9 by the optimum, 25 moves against 20
    assert "falls short" in ceiling
    assert "85.0 \u00b1 7.1 %" in ceiling
    assert "exact optimum 95.0 \u00b1 7.1" in ceiling
    assert "25.0" in ceiling
    assert "RRT-Connect 45.0" in rivals
    assert "MaskablePPO 85.0" in rivals
    assert "As printed** Rainbow inserts in 85.0" in printed
    assert "no clear difference, under masks that leave little to do, without" in components
    assert "does not reproduce" in components
    assert "85.0 \u00b1 7.1 to 85.0" in geometry


def test_what_was_not_run_is_not_told(tmp_path: Path) -> None:
    store = make_store(tmp_path, [0], "paper", lambda cell: cell.method == "rrt_connect")
    assert sentences(Results(store)) == [
        "**Beside it** stand RRT-Connect 50.0 %, on the same starts."
    ]


def solve(store: Store, run: str, share: float) -> None:
    """Rewrite a run's episodes: the first ``share`` of them is solved."""
    path = store.run(run).path / "episodes.csv"
    rows = pd.read_csv(path)
    rows["success"] = (rows["episode"] < share * (rows["episode"].max() + 1)).astype(int)
    rows.to_csv(path, index=False)


@pytest.mark.parametrize(
    ("before", "after", "verdict"),
    [
        (1.0, 1.0, "effect reproduces**"),
        (0.5, 1.0, "effect reproduces in part**"),
        (0.5, 0.5, "effect does not reproduce**"),
    ],
)
def test_the_design_stage_reproduces_only_at_the_ceiling(
    before: float, after: float, verdict: str, tmp_path: Path
) -> None:
    store = make_store(
        tmp_path,
        [0],
        "quick",
        lambda c: c.method in ("rainbow", "optimum") and c.ablation == "full",
    )
    solve(store, "rainbow-initial-tuned-s0", before)
    solve(store, "rainbow-optimized-tuned-s0", after)
    (told,) = [line for line in sentences(Results(store)) if "design stage" in line]
    assert verdict in told
    assert ("at the ceiling" in told) == (before == after == 1.0)


@pytest.mark.parametrize(
    ("holes", "reward", "blamed"),
    [(0.0, 30.0, True), (0.49, 0.01, True), (0.5, 30.0, False), (0.0, 0.0, False)],
)
def test_the_printed_reward_is_blamed_only_where_it_is_earned_without_holes(
    holes: float, reward: float, blamed: bool, tmp_path: Path
) -> None:
    store = make_store(tmp_path, [0], "paper", lambda c: c.track == "printed")
    solve(store, "rainbow-optimized-printed-s0", 0.0)
    path = store.run("rainbow-optimized-printed-s0").path / "curve.csv"
    rows = pd.read_csv(path).assign(holes=holes, episode_reward=reward)
    rows.to_csv(path, index=False)
    (told,) = [line for line in sentences(Results(store)) if "As printed" in line]
    assert f"fill {holes:.2f} holes" in told
    assert ("hovering" in told) == blamed


@pytest.fixture
def verdicts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[dict[str, float]], str]:
    """The sentences after some runs solved a share of 100 episodes, in one text."""
    monkeypatch.setattr(fabricated_store, "EPISODES", 100)

    def tell(shares: dict[str, float]) -> str:
        store = make_store(tmp_path, [0], "paper", lambda cell: cell.id in shares)
        for run, share in shares.items():
            solve(store, run, share)
        return "\n".join(sentences(Results(store)))

    return tell


@pytest.mark.parametrize(
    ("ours", "optimum", "verdict"),
    [
        (0.95, 0.95, "reproduces"),
        (0.94, 0.94, "falls short"),  # below 95 %
        (0.98, 1.00, "reproduces"),
        (0.97, 1.00, "falls short"),  # below 0.98 of the optimum's
    ],
)
def test_the_success_rate_reproduces_near_the_optimum(
    ours: float, optimum: float, verdict: str, verdicts: Callable[[dict[str, float]], str]
) -> None:
    told = verdicts({"rainbow-optimized-tuned-s0": ours, "optimum-optimized-s0": optimum})
    assert f"**The success rate {verdict}**" in told


@pytest.mark.parametrize(
    ("before", "after", "verdict"),
    [(0.49, 0.98, "reproduces"), (0.48, 0.98, "in part"), (0.49, 0.97, "in part")],
)
def test_the_design_stage_reproduces_near_both_optima(
    before: float, after: float, verdict: str, verdicts: Callable[[dict[str, float]], str]
) -> None:
    told = verdicts({
        "rainbow-initial-tuned-s0": before, "rainbow-optimized-tuned-s0": after,
        "optimum-initial-s0": 0.5, "optimum-optimized-s0": 1.0,
    })  # fmt: skip
    assert re.search(rf"effect (reproduces )?{verdict}\*\*", told)


@pytest.mark.parametrize(("share", "learns"), [(0.5, True), (0.49, False)])
def test_as_printed_it_learns_from_half_of_the_episodes_on(
    share: float, learns: bool, verdicts: Callable[[dict[str, float]], str]
) -> None:
    told = verdicts({"rainbow-optimized-printed-s0": share})
    assert told.startswith("**As printed** Rainbow inserts") == learns
    assert ("does not learn" in told) != learns


def test_a_component_counts_where_the_intervals_are_apart(
    verdicts: Callable[[dict[str, float]], str],
) -> None:
    runs = {f"rainbow-{name}-optimized-repaired-s0": 0.8 for name in ABLATIONS}
    runs.pop("rainbow-full-optimized-repaired-s0")
    runs |= {"rainbow-optimized-repaired-s0": 0.8, "rainbow-no_noisy-optimized-repaired-s0": 0.95}
    # Wilson's intervals of 80 and 70, or 88, of 100 overlap, those of 80 and 60, or 95, do not
    runs |= {f"rainbow-{name}-optimized-repaired-s0": share
             for name, share in (("no_dueling", 0.7), ("no_n_steps", 0.88))}  # fmt: skip
    told = verdicts(runs)
    assert "does not reproduce" in told
    assert re.search(r"more without [^;,]*95\.0[^;,]*;", told)
    assert "less without" not in told
    told = verdicts(runs | {"rainbow-no_double_q-optimized-repaired-s0": 0.6})
    assert "reproduces in part" in told
    assert re.search(r"less without [^;,]*60\.0[^;,]*;", told)


def test_the_last_episodes_count_once_each() -> None:
    curve = pd.DataFrame({
        "timesteps": [100, 900, 950, 980, 1000],
        "episodes": [1, 5, 6, 6, 9],
        "holes": [6.0, 6.0, 4.0, float("nan"), 2.0],
    })  # fmt: skip
    assert tail_mean(curve, "holes") == pytest.approx((1 * 4.0 + 3 * 2.0) / 4)
    assert math.isnan(tail_mean(curve[:1].assign(episodes=0), "holes"))
