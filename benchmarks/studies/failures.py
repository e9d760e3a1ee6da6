"""Where a learned policy fails, why, and by how much it is slower than the optimum.

The stored policies of all seeds play their test episodes again, up to the first insertion, beside
the exact optimum. A failure is *infeasible* if no sequence of moves inserts from that start,
*singular* if the episode ended by a singularity, *cycle* if the last moves ran through the same few
configurations, and else *wandering*: it went on and found no way. Of a distributional learner it
says how far the best action's value stands above the second best allowed one's. Written to
``results/<preset>/failures/`` as ``<method>-<track>``: ``.csv``, one row per episode, ``.md``,
``.png``.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.errors import BenchmarkError
from benchmarks.evaluation.evaluate import begin_episodes
from benchmarks.methods.episodes import env_arguments
from benchmarks.methods.oracle import LatticeOracle
from benchmarks.protocol.learners import LEARNERS
from benchmarks.protocol.plan import Cell, expand, settings
from benchmarks.protocol.presets import Preset, load_preset
from benchmarks.reporting.figures.style import canvas, save, style
from benchmarks.reporting.results import tail_mean
from benchmarks.reporting.stats import wilson
from benchmarks.reporting.tables.table import plain
from benchmarks.runs.store import Store, write_csv
from benchmarks.studies.base import Part, Study, Tick, greedy
from coop_env.kinematics.rotations import tilt_azimuth

RECENT: Final = 40  # moves at the end of an episode ...
FEW: Final = 4  # ... among which a cycle has at most so many configurations
TILT_EDGES: Final = (0.0, 10.0, 15.0, 20.0, 25.0, 45.0)  # degrees
COLOURS: Final = {"infeasible": "0.6", "singular": "C3", "cycle": "C1", "wandering": "C0"}
CAUSES: Final = tuple(COLOURS)


def play(
    preset: Preset, cell: Cell, model: Any, oracle: LatticeOracle, tick: Tick = lambda share: None
) -> list[dict[str, object]]:
    """One row per test episode of a cell's seed."""
    arguments = env_arguments(preset, cell, preset.tracks[cell.track])
    policy, tests, rows = greedy(model), preset.evaluation, []
    for episode in begin_episodes(arguments, cell.seed, tests.episodes, tests.stream):
        env = episode.env
        target, lean = int(env.state["target"]), env.configuration[3:5]
        roll, pitch = np.degrees(lean).tolist()
        plan = oracle.plan(env)
        trail, seen, allowed = [], [], []
        singular = False
        while not episode.over and not episode.insertions:
            seen.append(episode.observation)
            allowed.append(env.action_masks())
            singular = bool(episode.move(policy(seen[-1], allowed[-1]))["singular"])
            trail.append(env.state["offset"].tobytes())
        success = bool(episode.insertions)
        causes = {
            "infeasible": plan.moves is None,
            "singular": singular,
            "cycle": len(set(trail[-RECENT:])) <= FEW,
            "wandering": True,
        }
        rows.append(
            {
                "seed": cell.seed,
                "episode": episode.number,
                "start": episode.start,
                "target": target,
                "polar": math.degrees(env.task.holes[target][0]),
                "roll": roll,
                "pitch": pitch,
                "tilt": float(np.degrees(tilt_azimuth(lean)[0])),
                "optimum": math.nan if plan.moves is None else float(len(plan.moves)),
                "success": success,
                "moves": float(episode.moves) if success else math.nan,
                "gap": action_gap(model, np.array(seen), np.array(allowed)),
                "cause": "" if success else next(cause for cause in CAUSES if causes[cause]),
            }
        )
        tick(len(rows) / tests.episodes)
    return rows


def action_gap(model: Any, observations: NDArray[np.float32], masks: NDArray[np.bool_]) -> float:
    """The best allowed action's value over the second best's: median, as a share of the support.

    Args:
        model: a learner; NaN if its values have no support.
        observations: (n, size), of the states where it had to choose.
        masks: (n, 12); states with one allowed action do not count.
    """
    import torch

    net = getattr(model, "q_net", None)
    choices = masks.sum(axis=1) > 1
    if not getattr(net, "distributional", False) or not choices.any():
        return math.nan
    assert net is not None
    with torch.no_grad():
        values = net(torch.as_tensor(observations[choices], device=net.device)).cpu().numpy()
    best = np.sort(np.where(masks[choices], values, -np.inf), axis=1)[:, -2:]
    return float(np.median(best[:, 1] - best[:, 0]) / (net.v_max - net.v_min))


def read(path: Path) -> pd.DataFrame:
    """Stored rows as :func:`play` made them."""
    return pd.read_csv(path).astype({"success": bool}).fillna({"cause": ""})


def summary(rows: pd.DataFrame) -> str:
    """Success, the optimum's and the excess in moves by polar angle and tilt, and the causes."""
    table = []
    for label, result in [*_groups(rows, "hole at {:.0f}°"), ("all", rows)]:
        moves, optimum = result.loc[result["success"], ["moves", "optimum"]].dropna().sum()
        excess = 100.0 * (moves / optimum - 1.0) if optimum else math.nan
        shares = (result["success"].mean(), result["optimum"].notna().mean())
        table.append(
            [label, str(len(result)), *(f"{100 * x:.1f}" for x in shares), f"{excess:.1f}"]
        )
    failed, success = rows.loc[~rows["success"], "cause"].tolist(), rows["success"].mean()
    named = ", ".join(f"{failed.count(cause)} {cause}" for cause in CAUSES)
    head = "Starts | n | Success (%) | Optimum (%) | Moves over the optimum (%)"
    parts = [
        plain("The first hole, by its angle and by the tilt at the start", head, table),
        f"{len(failed)} failures of {len(rows)}: {named}.",
    ]
    acting = rows.groupby("seed")["acting"].first().mean()
    if not math.isnan(acting):  # a training episode ended there
        parts.append(
            f"The last tenth of training, with exploration: {100.0 * acting:.1f} % of its "
            f"episodes; the greedy policy on the test episodes: {100.0 * success:.1f} %."
        )
    cycles = rows["cause"] == "cycle"
    if gaps := [
        f"{100.0 * gap.median():.2f} % where it {what}"
        for gap, what in (
            (rows["gap"][rows["success"]], "inserts"),
            (rows["gap"][cycles], "cycles"),
        )
        if gap.notna().any()
    ]:
        parts.append(
            "The best action's value over the second best's, median, as a share of the support's "
            f"width: {', '.join(gaps)}."
        )
    return "\n\n".join(parts) + "\n"


def _groups(rows: pd.DataFrame, hole: str) -> list[tuple[str, pd.DataFrame]]:
    """Labels and rows by the hole's polar angle, then by the tilt at the start."""
    groups = [(hole.format(polar), result) for polar, result in rows.groupby("polar")]
    tilts = pd.Series(pd.cut(rows["tilt"], list(TILT_EDGES), include_lowest=True))
    return groups + [
        (f"tilt to {interval.right:.0f}°", result)
        for interval, result in rows.groupby(tilts, observed=True)
    ]


def draw(rows: pd.DataFrame) -> Figure:
    """Success and regret over polar angle and tilt, and the map of starts that fail."""
    figure, (success, regret, where) = canvas(1, 3, (10.5, 3.6), grid=False)
    bins = _groups(rows, "{:.0f}° hole")
    names = [name for name, _ in bins]
    at = np.arange(len(bins))
    shares = np.array([result["success"].mean() for _, result in bins])
    limits = np.array([wilson(int(result["success"].sum()), len(result)) for _, result in bins])
    errors = np.abs(limits.T - shares)
    success.bar(at, 100 * shares, yerr=100 * errors, color="C0", capsize=3, label="policy")
    ceiling = [100 * result["optimum"].notna().mean() for _, result in bins]
    success.plot(at, ceiling, "k_", markersize=18, label="exact optimum")
    success.set_ylabel("success at the first hole (%)")
    success.set_ylim(max(0.0, 100 * limits.min() - 10.0), 101.0)
    success.legend(loc="lower left", frameon=True)
    lost = [(f["moves"] - f["optimum"])[f["success"]].dropna().to_numpy() for _, f in bins]
    regret.boxplot(lost, positions=at, showfliers=False, whis=(5, 95))
    means = [values.mean() if len(values) else np.nan for values in lost]
    regret.plot(at, means, "o", color="C1", label="mean")
    regret.set_ylabel("moves more than the optimum")
    regret.legend()
    for axes in (success, regret):
        axes.set_xticks(at, names, rotation=60, fontsize=8)
    solved = rows[rows["success"]]
    where.plot(solved["roll"], solved["pitch"], ".", color="C2", alpha=0.25, label="inserted")
    for cause, result in rows[rows["cause"] != ""].groupby("cause"):
        label = f"{cause} ({len(result)})"
        where.plot(result["roll"], result["pitch"], "o", color=COLOURS[str(cause)], label=label)
    where.set(xlabel="roll at the start (°)", ylabel="pitch at the start (°)", aspect="equal")
    where.legend(frameon=True)
    return figure


class Failures(Study):
    """Where stored policies fail, and why."""

    name = "failures"
    options = {  # noqa: RUF012
        "--preset": {"default": "cut", "help": "whose stored policies"},
        "--track": {"default": "safe", "help": "their track"},
        "--method": {"default": "rainbow", "choices": LEARNERS, "help": "the learner"},
        "--geometry": {"default": "optimized", "help": "of the 3-RRS"},
    }

    def __init__(self, given: argparse.Namespace) -> None:
        super().__init__(given)
        self.preset = load_preset(given.preset)
        self.store = Store.open(self.results, self.preset.name)
        self.folder = self.store.folder / "failures"
        wanted = Cell(given.method, "full", given.geometry, given.track, 0)
        alike = (cell for cell in expand(self.preset) if replace(cell, seed=0) == wanted)
        self.cells = sorted(cell for cell in alike if self.store.run(cell.id).has_policy())
        if not self.cells:
            raise BenchmarkError(
                f"{self.store.folder} has no stored policy of {given.method}, track {given.track}, "
                f"geometry {given.geometry}; run: python -m benchmarks run --preset "
                f"{self.preset.name}"
            )
        for cell in self.cells:
            self.store.run(cell.id).check_config(settings(self.preset, cell))
        self.rows: list[dict[str, object]] = []

    def parts(self) -> dict[str, Part]:
        return {cell.id: partial(self._play, cell) for cell in self.cells}

    def _play(self, cell: Cell, tick: Tick) -> None:
        from benchmarks.evaluation.model_files import load_stored

        run = self.store.run(cell.id)
        model = load_stored(run.policy)
        # the share that it solved in the last tenth of its training, with its exploration
        acting = tail_mean(run.rows("curve"), "success")
        oracle = LatticeOracle(real=self.preset.tracks[cell.track].sim_to_real is not None)
        played = play(self.preset, cell, model, oracle, tick)
        self.rows += [{**row, "acting": acting} for row in played]

    def finish(self) -> None:
        name = f"{self.given.method}-{self.given.track}"
        if self.given.geometry != "optimized":
            name += f"-{self.given.geometry}"
        write_csv(self.folder / f"{name}.csv", self.rows)
        with style():
            save(draw(read(self.folder / f"{name}.csv")), self.folder / f"{name}.png")

    @classmethod
    def files(cls, results: Path) -> dict[Path, str]:
        paths = sorted(results.glob("*/failures/*.csv"))
        return {path.with_suffix(".md"): summary(read(path)) for path in paths}
