"""Stored policies of Rainbow as packages for the Hugging Face hub; nothing is uploaded.

    python -m benchmarks package --preset cut

Each policy of the whole algorithm that the preset's store holds for the optimized geometry (a fresh
clone has those of the README's table) becomes a folder of ``hub/<preset>/``: the model, a card with
command, results and versions, its settings, and the arguments of its environment. The card's return
is measured anew, on starts of no test; its success is that of the stored test episodes.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import yaml
from rich.console import Console
from rich.progress import Progress

from benchmarks.errors import BenchmarkError, at_least
from benchmarks.methods.episodes import env_arguments
from benchmarks.protocol.plan import Cell, expand, settings
from benchmarks.protocol.presets import Preset, load_preset
from benchmarks.protocol.seeding import derive
from benchmarks.reporting.results import Result
from benchmarks.runs.store import RunFolder, Store, write_text

ENV_ID: Final = "CoopInsertion-v0"
_ABOUT: Final = """\
On the {n} test episodes of seed {seed} of the benchmark's preset `{preset}` it inserts in
{success:.1f} % and fills {holes:.2f} of 6 holes.

Trained on track `{track}` at commit {commit}, with {versions}. The task is
`gymnasium.make("{env_id}", **arguments)` of `coop_env` with the arguments in `env_kwargs.yml`;
`config.yaml` holds every setting. The file has what the greedy policy needs, in the steps of half
precision, as it was tested: neither target network nor noise, so that it is not to be trained on.
"""


def find(preset: Preset, store: Store) -> list[tuple[Cell, RunFolder]]:
    """Runs of the whole algorithm on the optimized geometry whose policies are here.

    Raises:
        BenchmarkError: there is none, or one is not what its run stored.
    """
    cells = (cell for cell in expand(preset) if cell.method == "rainbow")
    whole = (cell for cell in cells if (cell.ablation, cell.geometry) == ("full", "optimized"))
    found = [(cell, store.run(cell.id)) for cell in sorted(whole)]
    found = [(cell, run) for cell, run in found if run.has_policy()]
    if not found:
        raise BenchmarkError(
            f"{store.folder} has no stored policy of rainbow on the optimized geometry; run: "
            f"python -m benchmarks run --preset {preset.name}"
        )
    for cell, run in found:
        run.check_config(settings(preset, cell))
        if run.meta()["training"]["policy_sha256"] != run.policy_digest():
            raise BenchmarkError(f"{run.policy} is not the policy that its meta.json is about")
    return found


def package(preset: Preset, cell: Cell, run: RunFolder, folder: Path, episodes: int) -> None:
    """Write one policy's package to ``folder``, in the place of what is there.

    Raises:
        BenchmarkError: the policy cannot be loaded, or has no form without a pickle.
    """
    from stable_baselines3.common.vec_env import VecMonitor

    from benchmarks.evaluation.model_files import load_stored
    from coop_env.vector.vec_env import CoopInsertionVecEnv
    from sb3_rainbow.zoo import hub
    from sb3_rainbow.zoo.files import ZooError

    model = load_stored(run.policy)
    given = env_arguments(preset, cell, preset.tracks[cell.track])
    arguments = {name: value for name, value in given.items() if value}
    env = VecMonitor(CoopInsertionVecEnv(1, seed=derive("fresh", cell.seed), **arguments))
    shutil.rmtree(folder, ignore_errors=True)
    try:
        hub.package(
            model,
            ENV_ID,
            folder,
            eval_env=env,
            command=f"python -m benchmarks train --preset {preset.name} --cell {cell.id}",
            n_eval_episodes=episodes,
            about=_about(preset, cell, run),
        )
    except ZooError as error:
        raise BenchmarkError(f"{run.policy}: {error}") from error
    write_text(folder / "env_kwargs.yml", yaml.safe_dump(arguments))
    shutil.copy(run.path / "config.yaml", folder)


def _about(preset: Preset, cell: Cell, run: RunFolder) -> str:
    tests, meta = Result.read(run).test(), run.meta()
    told: dict[str, Any] = meta["versions"]
    names = ("python", "torch", "stable-baselines3", "gymnasium", "numpy")
    return _ABOUT.format(
        n=len(tests),
        seed=cell.seed,
        preset=preset.name,
        success=100.0 * tests["success"].mean(),
        holes=tests["holes"].mean(),
        track=cell.track,
        commit=meta["commit"][:9],
        versions=", ".join(f"{name} {told[name]}" for name in names),
        env_id=ENV_ID,
    )


def main(words: Sequence[str]) -> int:
    """Package every policy that is here."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks package",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--preset", default="cut")
    parser.add_argument("--results", type=Path, default=Path("results"), help="results folder")
    parser.add_argument("--out", type=Path, default=Path("hub"), help="folder of the packages")
    parser.add_argument("--episodes", type=at_least(1), default=20, help="of each card's return")
    given = parser.parse_args(list(words))
    try:
        import sb3_rainbow.zoo.hub  # noqa: F401
    except ImportError as error:
        raise BenchmarkError(f"package needs pip install '.[zoo]': {error}") from error
    preset = load_preset(given.preset)
    found = find(preset, Store.open(given.results, preset.name))
    console = Console(soft_wrap=True)
    out = given.out / preset.name
    with Progress(console=console) as progress:
        for cell, run in progress.track(found, description="packages"):
            package(preset, cell, run, out / cell.id, given.episodes)
    console.print(f"{len(found)} packages: {out}", markup=False)
    return 0
