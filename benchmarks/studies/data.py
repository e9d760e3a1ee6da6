"""Minari datasets of the insertion task, for offline learners.

Four behaviours act on the track `safe`, under its masks: the exact *optimum*, which ends where no
moves insert; the *expert*, two-move lookahead from the observation; *medium*, the expert with a
share of its moves drawn from the allowed ones; and *random* moves, drawn from the allowed ones.
Episode k begins at the same state for all; no test, validation or training begins there. An
interrupted dataset begins anew, complete ones are kept. With ``--contact`` the scripts of the
contact task act in it, and ``infos`` hold its privileged state.
"""

import json
import os
import tempfile
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from importlib.metadata import metadata
from pathlib import Path
from typing import Any, Final
from unittest import mock

import gymnasium
import numpy as np

from benchmarks.errors import BenchmarkError
from benchmarks.evaluation.evaluate import with_random_moves
from benchmarks.methods.controls import control
from benchmarks.methods.episodes import Episode, env_arguments
from benchmarks.methods.oracle import LatticeOracle
from benchmarks.protocol.metrics import N_HOLES
from benchmarks.protocol.plan import Cell
from benchmarks.protocol.presets import load_preset
from benchmarks.protocol.seeding import derive
from benchmarks.reporting.tables.table import Table, TableCell
from benchmarks.runs.machine import describe
from benchmarks.runs.store import write_text
from benchmarks.studies.base import OfOneFile, Part, Tick, by_plans, count, read_stored
from benchmarks.studies.robots.trials import begun, script_of
from coop_env.env import CoopInsertionEnv

NAMESPACE: Final = "coop-insertion"
TRACK: Final = "safe"
SMALL: Final = 2_000  # steps of the dataset that is in git
# with three of four moves random the expert succeeds about half as often on these starts
RANDOM_SHARE: Final = {"expert": 0.0, "medium": 0.75, "random": 1.0}
BEHAVIOURS: Final = {
    "optimum": "exact optimum",
    "expert": "two-move lookahead from the observation",
    "medium": f"expert, {RANDOM_SHARE['medium']:.0%} of the moves random",
    "random": "random",
}
CONTACT: Final = {
    "contact-push": "compliant push",
    "contact-moment": "moment-guided search",
    "contact-spiral": "spiral search",
}
Script = Callable[[Any], Any]  # from an observation to an action, or None
Played = tuple[Any, int]  # an episode in Minari's buffer, and how many holes it filled


@dataclass(frozen=True)
class Recipe:
    """The settings of a dataset. ``behaviour`` is one of ``BEHAVIOURS`` or ``CONTACT``."""

    name: str
    behaviour: str
    steps: int

    @property
    def id(self) -> str:
        """Minari's name of the dataset, which is also its folder."""
        return f"{NAMESPACE}/{self.name}-v0"

    def settings(self) -> dict[str, Any]:
        """The settings as the dataset's metadata has them."""
        share = RANDOM_SHARE.get(self.behaviour, 0.0)
        return {"behaviour": self.behaviour, "at_least": self.steps, "random_share": share}

    def environment(self) -> Any:
        """The environment, as Minari recreates it."""
        if self.behaviour in CONTACT:
            return gymnasium.make("CoopInsertionContact-v0")
        preset, cell = load_preset("cut"), Cell("rainbow", "full", "optimized", TRACK, 0)
        given = env_arguments(preset, cell, preset.tracks[TRACK])
        unlike = {name: value for name, value in given.items() if value}  # the defaults
        return gymnasium.make("CoopInsertion-v0", **unlike)

    @property
    def title(self) -> str:
        """Who acts."""
        return {**BEHAVIOURS, **CONTACT}[self.behaviour]


def recipes(steps: int, contact: bool = False) -> list[Recipe]:
    """All datasets of one command; the small one of the moves comes first."""
    if contact:
        return [Recipe(name, name, steps) for name in CONTACT]
    small = Recipe("optimum-small", "optimum", min(steps, SMALL))
    return [small, *(Recipe(name, name, steps) for name in BEHAVIOURS)]


def play(recipe: Recipe, progress: Callable[[int], None]) -> list[Played]:
    """Whole episodes from the first on, until together they have the recipe's steps."""
    env, kept, done = recipe.environment().unwrapped, list[Played](), 0
    begin = _acting(recipe, env)
    while done < recipe.steps:
        number = len(kept)
        kept.append(record(env, derive("data", number), begin(number)))
        done += len(kept[-1][0])
        progress(done)
    return kept


def record(env: Any, seed: int, act: Script) -> Played:
    """Play an episode to its end; where ``act`` has no action after an observation, it is cut off.

    Observations and infos begin before the first step.
    """
    from minari.data_collector import EpisodeBuffer

    moves, (seen, info), over = isinstance(env, CoopInsertionEnv), env.reset(seed=seed), False
    result = EpisodeBuffer(seed=seed, observations=[], actions=[], infos={})
    while True:
        result.observations.append(seen)
        shown = (
            {"action_masks": env.action_masks(), "n_filled": int(info["n_filled"])}
            if moves
            else {"privileged": info["privileged"]}
        )
        for name, value in shown.items():
            result.infos.setdefault(name, []).append(value)
        if over or (action := act(seen)) is None:
            break
        seen, reward, terminated, truncated, info = env.step(action)
        result.actions.append(action)
        result.rewards.append(reward)
        result.terminations.append(terminated)
        result.truncations.append(truncated)
        over = terminated or truncated
    if result.rewards and not over:
        result.truncations[-1] = True
    return result, int(info["n_filled"] if moves else info["success"])


def _acting(recipe: Recipe, env: Any) -> Callable[[int], Script]:
    """Who acts in an episode, by its number."""
    if recipe.behaviour == "optimum":
        oracle = LatticeOracle()
        return lambda _: by_plans(env, oracle.plan)
    if recipe.behaviour in CONTACT:
        return lambda _: begun(script_of(recipe.title, env, {}))
    track, share = load_preset("cut").tracks[TRACK], RANDOM_SHARE[recipe.behaviour]
    expert = control("lookahead_observed", track.controls, 0)([Episode(env, 0, 0)])

    def begin(number: int) -> Script:
        rng = np.random.default_rng(derive("data", number, 1))
        choose = with_random_moves(expert, [rng], share)
        return lambda seen: int(choose(seen[None], env.action_masks()[None], [0])[0])

    return begin


def measure(episodes: Sequence[Played], most: int = N_HOLES) -> dict[str, Any]:
    """The figures of a dataset for metadata and table; starts without a move count too."""
    rewards = np.array([sum(buffer.rewards) for buffer, _ in episodes])
    holes = np.array([filled for _, filled in episodes])
    return {
        "steps": sum(len(buffer) for buffer, _ in episodes),
        "starts": len(episodes),
        "episodes": sum(len(buffer) > 0 for buffer, _ in episodes),
        "success": float((holes > 0).mean()),
        "all_holes": float((holes == most).mean()),
        "holes": float(holes.mean()),
        "return": float(rewards.mean()),
        "return_std": float(rewards.std()),
    }


def write(root: Path, recipe: Recipe, episodes: Sequence[Played]) -> None:
    """Make the dataset beside its place and rename it into it."""
    import minari

    buffers = [buffer for buffer, _ in episodes if len(buffer)]
    root.mkdir(parents=True, exist_ok=True)
    root = root.resolve()  # Minari loses its way below a relative folder
    with tempfile.TemporaryDirectory(dir=root, prefix=".") as temporary, minari_root(temporary):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # it asks for an e-mail address
            dataset = minari.create_dataset_from_buffers(
                recipe.id,
                buffers,
                env=recipe.environment(),
                algorithm_name=recipe.title,
                author=metadata("sb3-rainbow-coop")["Author"],
                description=f"Insertion by the {recipe.title}, with "
                + ("privileged state" if recipe.behaviour in CONTACT else "action masks"),
            )
        measured = measure(episodes, 1 if recipe.behaviour in CONTACT else N_HOLES)
        about = {"settings": recipe.settings(), "measured": measured}
        dataset.storage.update_metadata({**about, "commit": describe()["commit"]})
        (root / NAMESPACE).mkdir(exist_ok=True)
        for made in sorted((Path(temporary) / NAMESPACE).iterdir()):
            if made.is_dir() or not (root / NAMESPACE / made.name).exists():
                made.rename(root / NAMESPACE / made.name)


def minari_root(folder: str | os.PathLike[str]) -> AbstractContextManager[Any]:
    """A context in which Minari reads and writes its datasets in this folder."""
    return mock.patch.dict(os.environ, {"MINARI_DATASETS_PATH": os.fspath(folder)})


def read(root: Path, recipe: Recipe) -> dict[str, Any] | None:
    """The metadata of a dataset, None if it is missing; BenchmarkError if the recipe differs."""
    path = root / recipe.id / "data" / "metadata.json"
    if not path.is_file():
        return None
    result = read_stored(path)
    if result["settings"] != recipe.settings():
        raise BenchmarkError(
            f"{root / recipe.id} was made by {result['settings']}, this is {recipe.settings()}: "
            "delete it, or name another --results"
        )
    size = sum(part.stat().st_size for part in path.parent.iterdir())
    about = {"id": recipe.id, "behaviour": recipe.title, "megabytes": size / 1e6}
    return {**about, **result["measured"]}


class Data(OfOneFile):
    """Minari datasets of the task."""

    name, file = "data", "data/data.json"
    needs = ("h5py", "minari", "data")
    options = {  # noqa: RUF012
        "--steps": count(100_000, "least steps of each dataset"),
        "--contact": {"action": "store_true", "help": "demonstrations of the contact task"},
    }

    def parts(self) -> dict[str, Part]:
        todo = [r for r in self._recipes() if read(self.folder, r) is None]
        return {recipe.id: partial(self._make, recipe) for recipe in todo}

    def _make(self, recipe: Recipe, tick: Tick) -> None:
        write(self.folder, recipe, play(recipe, lambda n: tick(n / recipe.steps)))

    def finish(self) -> None:
        path = self.results / self.file
        stored = read_stored(path) if path.is_file() else []
        made = (read(self.folder, recipe) for recipe in self._recipes())
        records = {record["id"]: record for record in [*stored, *made] if record}
        write_text(path, json.dumps(list(records.values()), indent=1) + "\n")

    def _recipes(self) -> list[Recipe]:
        return recipes(self.given.steps, self.given.contact)

    @staticmethod
    def to_markdown(result: Sequence[Mapping[str, Any]]) -> str:
        rows: list[list[TableCell]] = [
            [
                f"`{record['id']}`",
                record["behaviour"],
                f"{record['steps']:,}",
                f"{record['starts']:,}",
                f"{100.0 * record['success']:.1f}",
                f"{record['holes']:.2f}",
                f"{100.0 * record['all_holes']:.1f}",
                f"{record['return']:.1f} ± {record['return_std']:.1f}",
                f"{record['megabytes']:.1f}",
            ]
            for record in result
        ]
        notes = [
            "Success: episodes with an insertion, of all starts; return: mean ± std of the "
            "episodes.",
            "Nothing inserts from more starts than the exact optimum: its rows are the ceiling.",
        ]
        if any("/contact-" in record["id"] for record in result):
            notes.append("The contact task, `contact-`, has other starts and one hole.")
        header = ["Dataset", "Behaviour", "Steps", "Starts", "Success (%)", "Holes (of 6)"]
        header += ["All six (%)", "Return", "MB"]
        title = "Datasets of the insertion task"
        return Table("data", title, header, rows, notes, (0, 1)).markdown()
