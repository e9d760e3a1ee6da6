"""The 3-RRS is chosen for what the team achieves.

Two studies, of (lambda1, lambda2) and of (L2, home heave), in two steps. The exact optimum with
both robots moving at once scores designs for Optuna's NSGA-II: success and mean ticks. Then a
policy is trained on each of the designs that were chosen, over seeds, and tested on test starts.
What is complete is kept: the same command goes on. Written to ``results/codesign/`` and to a block
of ``docs/codesign.md``.
"""

from __future__ import annotations

import argparse
import json
import time
from functools import partial
from pathlib import Path
from typing import Any, Final

import yaml
from rich.console import Console

from benchmarks.errors import BenchmarkError, at_least
from benchmarks.runs.backends import LocalBackend
from benchmarks.runs.experiment import Experiment
from benchmarks.runs.harness import Harness
from benchmarks.runs.machine import describe
from benchmarks.runs.store import RunFolder, Store, write_text
from benchmarks.studies.base import Part, Study, Tick
from benchmarks.studies.codesign import spaces
from benchmarks.studies.codesign.result import POLICIES, TABLES, SearchResult
from benchmarks.studies.codesign.spaces import ALL, BASE, OF_ONE, STUDIES
from benchmarks.studies.codesign.text import to_markdown
from benchmarks.studies.insertion import Insertion
from coop_env.geometry import GEOMETRIES

EPISODES: Final = 100  # of a test, for each seed


class Codesign(Study):
    """Designs by the optimum, and policies on the chosen ones."""

    name = "codesign"
    needs = ("optuna", "tune")
    options = {  # noqa: RUF012
        "--designs": {"type": at_least(2), "default": 300, "help": "designs scored per study"},
        "--starts": {"type": at_least(2), "default": 200, "help": "validation starts per design"},
        "--seeds": {"type": at_least(2), "default": 5, "help": "trainings per chosen design"},
        "--policy-steps": {"type": at_least(1), "default": None, "help": "steps of each"},
        "--jobs": {"type": at_least(1), "default": None, "help": "processes"},
    }

    def __init__(self, given: argparse.Namespace) -> None:
        super().__init__(given)
        self.run_folder = RunFolder(self.folder)
        names = ("designs", "starts", "seeds", "policy_steps")
        self.asked: dict[str, Any] = {
            **{"geometry": BASE, "bounds": []},
            **{name: getattr(given, name) for name in names},
        }
        self.run_folder.begin(self.asked)
        self.rows: list[dict[str, Any]] = []
        self.skipped: dict[str, Any] = {}
        self.began = time.process_time()

    def parts(self) -> dict[str, Part]:
        if (self.folder / "codesign.json").is_file():
            return {}
        searches = {study: partial(self._search, study) for study in STUDIES}
        return {"named designs": self._score_named, **searches}

    def _score(self, name: str, study: str, geometry: Any) -> None:
        from benchmarks.studies.codesign.search import row_of

        result = spaces.optimum(geometry, 0, self.asked["starts"])
        self.rows.append({"design": name, **row_of(study, geometry, result)})

    def _score_named(self, tick: Tick) -> None:
        for name, geometry in GEOMETRIES.items():
            self._score(name, ALL if name == BASE else "lambdas", geometry)
        self.floor = min(row["success"] for row in self.rows)
        for study in STUDIES:
            self._score(f"{study}-area", study, spaces.geometry_of(spaces.area_best(study)))

    def _search(self, study: str, tick: Tick) -> None:
        from benchmarks.studies.codesign.search import Search

        one, starts = Search(self.folder, study, self.floor), self.asked["starts"]
        self.rows += one.run(
            self.asked["designs"], partial(spaces.optimum, seed=0, starts=starts), tick
        )
        bounds = {name: spaces.BOUNDS[name] for name in STUDIES[study]}
        self.skipped[study] = {"skipped": one.skipped(), "bounds": bounds}

    def finish(self) -> None:
        from benchmarks.studies.codesign.figures import write_figures

        if self.rows:
            self._write_search()
        with self.run_folder.lock():
            _choose(self.run_folder, self.asked["seeds"])
            self._train(Insertion(str(_write_preset(self.run_folder))))
        write_figures(SearchResult(self.folder))

    def _write_search(self) -> None:
        self.run_folder.write_rows("designs", self.rows)
        summary = {
            "command": self.given.command, "machine": describe(),
            "cpu_seconds": time.process_time() - self.began, "floor": self.floor,
            "most": spaces.MOST, "base": BASE, "studies": self.skipped,
        }  # fmt: skip
        write_text(self.folder / "codesign.json", json.dumps(summary, indent=1) + "\n")

    def _train(self, experiment: Experiment[Any]) -> None:
        """Run the cells of an experiment that are missing.

        Raises:
            BenchmarkError: some failed.
            KeyboardInterrupt: it was interrupted; what was done is kept.
        """
        store, console = experiment.open_store(self.folder, create=True), Console(soft_wrap=True)
        with store.lock():
            backend = LocalBackend(self.given.jobs)
            outcome = Harness(experiment, store, backend, console).run()
            if outcome.interrupted:
                raise KeyboardInterrupt
            if outcome.close(store, console, lambda: None):
                raise BenchmarkError(f"{store.folder}: runs failed; the same command tries again")

    @classmethod
    def files(cls, results: Path) -> dict[Path, str]:
        folder = results / "codesign"
        if not (folder / "chosen.csv").is_file():
            return {}
        return {folder / TABLES: to_markdown(SearchResult(folder)) + "\n"}

    @classmethod
    def problems(cls, results: Path) -> list[str]:
        from benchmarks.reporting.verify import check_runs

        return super().problems(results) + check_runs(Store(results / "codesign", POLICIES))


def _choose(folder: RunFolder, seeds: int) -> None:
    """The optimum of the chosen designs on their test starts: chosen.csv, unless it is there."""
    result = SearchResult(folder.path)
    chosen = result.choose()
    if folder.has_rows("chosen"):
        stored = zip(result.chosen["design"], result.chosen["chosen"], strict=True)
        if dict(stored) == chosen:
            return
    rows = []
    for design, why in chosen.items():
        geometry = result.geometry(design)
        known = {"design": design, "chosen": why, "sigma_cone": spaces.margin(geometry)}
        rows += [
            known | {"seed": seed, **vars(spaces.optimum(geometry, seed, EPISODES, "test"))}
            for seed in range(seeds)
        ]
    folder.write_rows("chosen", rows)


def _write_preset(folder: RunFolder) -> Path:
    """The preset that trains a policy on each of the chosen designs."""
    asked, result = folder.config(), SearchResult(folder.path)
    chosen = list(result.choose())
    own = [design for design in chosen if design not in GEOMETRIES]
    preset = {
        "description": "A policy on each of the designs that the co-design chose",
        "seeds": list(range(asked["seeds"])),
        "evaluation": {"episodes": EPISODES, "noise": [0.0], "stream": "test"},
        "tracks": {OF_ONE: {"timesteps": asked["policy_steps"]} if asked["policy_steps"] else None},
        "geometries": {design: result.geometry(design).as_dict() for design in own},
        "runs": [{"methods": ["rainbow"], "geometries": chosen, "tracks": [OF_ONE]}],
    }
    path = folder.path / f"{POLICIES}.yaml"
    write_text(path, yaml.safe_dump(preset, sort_keys=False))
    return path
