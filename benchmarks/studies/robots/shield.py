"""What the shield is worth: a certificate over the lattice, an adversary, and its price.

    python -m benchmarks study shield

The lattice through one start state is looked at in full, and so many others in a sample: no move
that the shield allows may harm the nominal machine, on its way or at its end. Then the machine errs
(`SimToReal`), and an adversary takes of the allowed moves one with the least margins left. Last,
random, adversarial and learned policies play validation starts with and without the shield: its
interventions, and what it costs, in moves and (with MuJoCo) by increments in contact. Random
machines are looked at too, and the worst within the bounds of their errors.
"""

from __future__ import annotations

import argparse
import contextlib
import math
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

from benchmarks.errors import BenchmarkError, at_least
from benchmarks.evaluation.evaluate import model_policy
from benchmarks.evaluation.model_files import load_model
from benchmarks.protocol.seeding import derive, episode_seeds
from benchmarks.reporting.tables.table import plain
from benchmarks.studies.base import Measured, Part, Tick, source
from benchmarks.studies.robots.shield_machines import CONFIGURATIONS, ERRORS, at_the_margin, search
from benchmarks.studies.robots.trials import LEVEL, inserter, play
from coop_env import CoopInsertionEnv, SimToReal
from coop_env.shield import KinematicShield, ShieldMargin, ShieldWrapper
from coop_env.shield.certificate import NOTHING, certify_lattice, check_product, lattice

TASK: Final[dict[str, Any]] = {"reward": "progress"}
SAMPLE: Final = 30  # points of each robot, of a sampled lattice
LADDER: Final = (1.3, 1.7, 2.2, 3.0, 4.0)  # the adversary measures what is left in margins
# learned policies: their name in the table, and their runs
LEARNED: Final = {
    "Rainbow": "cut/runs/rainbow-optimized-safe",
    "Rainbow trained with it": "shielded/runs/rainbow-optimized-shielded",
}

Masks = NDArray[np.bool_]
Choice = Callable[[NDArray[Any], Masks, Any], int]


class Adversary:
    """Takes, of the moves it may, one after which the least of the margins is left."""

    def __init__(self, env: CoopInsertionEnv, rng: np.random.Generator) -> None:
        unit = asdict(ShieldMargin())
        self._shields = [
            KinematicShield(env, ShieldMargin(**{name: m * unit[name] for name in unit}))
            for m in (1.0, *LADDER)
        ]
        self._rng = rng

    def __call__(self, observation: NDArray[Any], masks: Masks, env: CoopInsertionEnv) -> int:
        """The move."""
        here, steps = env.configuration, self._shields[0].steps
        left = np.full(len(masks), np.inf)
        for move in np.flatnonzero(masks).tolist():
            to = here.copy()
            to[move // 2] += steps[move // 2] * (1 - 2 * (move % 2))
            left[move] = sum(shield.is_certified(to) for shield in self._shields)
        return int(self._rng.choice(np.flatnonzero(left == left.min())))


def _random(rng: np.random.Generator) -> Choice:
    return lambda observation, masks, env: int(rng.choice(np.flatnonzero(masks)))


def certificates(phases: int, in_full: bool, tick: Tick) -> dict[str, Any]:
    """The lattice of one start in full, and samples of so many others."""
    env = CoopInsertionEnv(**TASK)
    shield = KinematicShield(env)
    env.reset(seed=derive("validate", 0, 0))
    result = {}
    if in_full:
        full = certify_lattice(shield, env.params, env.configuration, lambda share: tick(share / 2))
        result["full"] = full._asdict()
    sampled = NOTHING
    rng = np.random.default_rng(derive("fresh", 13))
    for phase in range(phases):
        env.reset(seed=derive("validate", 1, phase))
        delta, rrs = (
            part[rng.choice(len(part), SAMPLE, replace=False)]
            for part in lattice(env.params, env.configuration)
        )
        sampled += check_product(shield, env.params, delta, rrs)
        tick(0.5 + 0.5 * (phase + 1) / phases)
    return {**result, "sampled": sampled._asdict()}


def harm_of(real: SimToReal, moves: int, shielded: bool, tick: Tick) -> dict[str, int]:
    """Collisions and singular ends in so many of the adversary's moves."""
    env = CoopInsertionEnv(**TASK, sim_to_real=real, mask_singularities=True)
    rng = np.random.default_rng(derive("fresh", 14))
    wrapped = ShieldWrapper(env)
    player, choose = (wrapped if shielded else env), Adversary(env, rng)
    result = {"moves": 0, "collisions": 0, "singular": 0, "episodes": 0}
    while result["moves"] < moves:
        observation, _ = player.reset(seed=derive("validate", 2, result["episodes"]))
        result["episodes"] += 1
        over = False
        while not over and result["moves"] < moves:
            action = choose(observation, player.action_masks(), env)
            observation, _, terminated, truncated, info = player.step(action)
            over = terminated or truncated
            result["moves"] += 1
            result["collisions"] += bool(info["collision"])
            result["singular"] += bool(info["singular"])
        tick(result["moves"] / moves)
    return result


def price_of(
    make: Callable[[CoopInsertionEnv], Choice], arguments: dict[str, Any], shielded: bool,
    seed: int, episodes: int,
) -> dict[str, float]:  # fmt: skip
    """A policy on validation starts: success, time, harm and interventions, means an episode.

    An intervention is a choice that the shield forbids; the policy then chooses under its masks.
    """
    env = CoopInsertionEnv(**arguments)
    shield, choose = ShieldWrapper(env), make(env)
    rows = []
    for start in episode_seeds(seed, episodes, "validate"):
        observation, info = env.reset(seed=start)
        filled, harm, changed, time, over = 0, 0, 0, math.nan, False
        while not over:
            action = choose(observation, env.action_masks(), env)
            masks = shield.action_masks()
            if shielded and not masks[action]:
                changed += 1
                action = choose(observation, masks, env)
            observation, _, terminated, truncated, info = env.step(action)
            over = terminated or truncated
            harm += bool(info["collision"]) or bool(info["singular"])
            if info["inserted"] and not filled:
                time = info["time"]
            filled += bool(info["inserted"])
        rows.append((filled > 0, filled, time, harm, changed))
    success, holes, times, harm_done, changes = np.array(rows, float).T
    return {
        "success": 100.0 * float(success.mean()), "holes": float(holes.mean()),
        "time": float(np.nanmean(times)) if success.any() else math.nan,
        "harm": float(harm_done.mean()), "interventions": float(changes.mean()),
    }  # fmt: skip


def _learned(path: Path) -> Callable[[CoopInsertionEnv], Choice]:
    def make(env: CoopInsertionEnv) -> Choice:
        act = model_policy(load_model(path))
        return lambda observation, masks, _: int(act(observation[None], masks[None])[0])

    return make


def prices(results: Path, episodes: int, seeds: int, tick: Tick) -> list[dict[str, Any]]:
    """Who plays, under which masks of its own, and what the shield changes, over seeds.

    Learned policies that are not among the results are left out.
    """
    paper, safe = TASK, {**TASK, "mask_singularities": True}
    players: list[tuple[str, str, dict[str, Any], Callable[..., Any]]] = [
        ("random", "paper's", paper, lambda seed: lambda env: _random(_rng(seed))),
        ("random", "safe", safe, lambda seed: lambda env: _random(_rng(seed))),
        ("adversary", "safe", safe, lambda seed: lambda env: Adversary(env, _rng(seed))),
    ]

    def learned(runs: str, seed: int) -> Callable[[CoopInsertionEnv], Choice]:
        return _learned(results / f"{runs}-s{seed}" / "policy.zip")

    for name, runs in LEARNED.items():
        if (results / f"{runs}-s0" / "policy.zip").is_file():
            own = partial(learned, runs)
            players += [(name, "paper's", paper, own), (name, "safe", safe, own)]
    rows, done = [], 0
    for name, masks, arguments, maker in players:
        for shielded in (False, True):
            result = []
            for seed in range(seeds):
                result.append(price_of(maker(seed), arguments, shielded, seed, episodes))
                done += 1
                tick(done / (2 * seeds * len(players)))
            numbers = {key: [one[key] for one in result] for key in result[0]}
            rows.append({"policy": name, "masks": masks, "shield": shielded, **numbers})
    return rows


class Increments:
    """Uniform increments in the contact task."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def reset(self) -> None:
        """It keeps nothing from step to step."""

    def __call__(self, observation: Any) -> NDArray[np.float32]:
        """Increments (6,), whatever is observed."""
        return self._rng.uniform(-1.0, 1.0, 6).astype(np.float32)


def in_contact(results: Path, episodes: int, seeds: int, tick: Tick) -> list[dict[str, Any]]:
    """Increments in the contact task, with and without the shield; none where MuJoCo is missing.

    What is not among the results is left out.
    """
    try:
        from coop_env.physics.env import CoopInsertionContactEnv
    except DependencyNotInstalled:
        return []
    players: dict[str, Callable[[int], Any]] = {"random": lambda seed: Increments(_rng(seed))}
    for name in ("spiral search", "SAC"):
        with contextlib.suppress(BenchmarkError):
            inserter(results, name, 0)
            players[name] = partial(inserter, results, name)
    env, rows = CoopInsertionContactEnv(LEVEL), []
    worlds: dict[bool, Any] = {False: env, True: ShieldWrapper(env)}
    for done, (name, shielded) in enumerate(product(players, worlds)):
        result: dict[str, list[float]] = {"success": [], "harm": [], "interventions": []}
        also = ("interventions",) if shielded else ()
        for seed in range(seeds):
            player = players[name](seed)
            row = play(worlds[shielded], player, "validate", episodes, also=also)
            result["success"].append(100.0 * float(np.mean(row["success"])))
            harmed = [cause in ("force", "snap") for cause in row["failure"]]
            result["harm"].append(float(np.mean(harmed)))
            result["interventions"].append(float(np.mean(row.get("interventions", 0.0))))
        rows.append({"policy": name, "shield": shielded, **result})
        tick((1 + done) / (2 * len(players)))
    return rows


def _rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(derive("fresh", 15, seed))


def _numbers(row: dict[str, Any], **digits: int) -> list[str]:
    """Mean and standard deviation over seeds, with so many digits of each."""
    return [
        f"{np.nanmean(row[key]):.{n}f} ± {np.nanstd(row[key], ddof=1):.{n}f}"
        if np.isfinite(row[key]).sum() > 1
        else "-"
        for key, n in digits.items()
    ]


def _other_machines(parts: dict[str, Any]) -> Iterator[str]:
    if "machines" in parts:
        yield plain(
            "Random machines: moves that the shield allows where the robots may meet",
            "machines | moves | harmful",
            [[f"{parts['machines'][key]:,}" for key in ("machines", "moves", "harmful")]],
        )
        yield plain(
            "The worst machine within the bounds of its errors, its model at the margin",
            "errors | configurations | harmed",
            [
                [name, f"{one['configurations']:,}", f"{one['harmed']:,}"]
                for name in ERRORS
                for one in [parts[f"{name}: margin"]]
            ],
        )


class Shield(Measured):
    """The shield: its certificate, an adversary, its price, other machines."""

    name, file = "shield", "shield/shield.json"
    options = {  # noqa: RUF012
        "--phases": {"type": at_least(1), "default": 1000, "help": "sampled lattices"},
        "--moves": {
            "type": at_least(1), "default": 1_000_000, "help": "the adversary's, on each machine",
        },
        "--episodes": {"type": at_least(1), "default": 20, "help": "of each policy and seed"},
        "--seeds": {"type": at_least(2), "default": 5, "help": "number of seeds"},
        "--full": {
            "action": argparse.BooleanOptionalAction, "default": True,
            "help": "one lattice in full",
        },
        "--machines": {"type": at_least(1), "default": 20, "help": "random machines"},
    }  # fmt: skip

    def asked(self) -> dict[str, Any]:
        return super().asked() | {"margin": asdict(ShieldMargin())}

    def measures(self) -> dict[str, Part]:
        given = self.given
        sample = (given.results, given.episodes, given.seeds)
        bare = max(1, given.moves // 100)
        return {
            "prices": partial(prices, *sample),
            "contact": partial(in_contact, *sample),
            "certificate": partial(certificates, given.phases, given.full),
            **{
                f"{name}: {way}": partial(harm_of, real, *of_way)
                for name, real in ERRORS.items()
                for way, of_way in {"bare": (bare, False), "shielded": (given.moves, True)}.items()
            },
            "machines": partial(search, given.machines),
            **{
                f"{name}: margin": lambda _, of=real: at_the_margin(of, CONFIGURATIONS)  # type: ignore[misc]
                for name, real in ERRORS.items()
            },
        }

    @staticmethod
    def to_markdown(result: dict[str, Any]) -> str:
        """The measurements as Markdown."""
        asked, parts = result["asked"], result["parts"]
        names = {"full": "one start's, in full", "sampled": f"{asked['phases']:,} starts', sampled"}
        looked = [
            [
                names[key],
                *(f"{one[what]:,}" for what in ("points", "moves", "harmful", "dead_ends")),
            ]
            for key, one in parts["certificate"].items()
        ]
        harms = [
            [name, "yes" if way == "shielded" else "no"]
            + [f"{parts[f'{name}: {way}'][what]:,}" for what in ("moves", "collisions", "singular")]
            for name in ERRORS
            for way in ("bare", "shielded")
        ]
        costs = [
            [row["policy"], row["masks"], "yes" if row["shield"] else "no",
             *_numbers(row, success=1, holes=2, time=1, harm=2, interventions=1)]
            for row in parts["prices"]
        ]  # fmt: skip
        touched = [
            [row["policy"], "yes" if row["shield"] else "no",
             *_numbers(row, success=1, harm=2, interventions=1)]
            for row in parts["contact"]
        ]  # fmt: skip
        margin = ", ".join(f"{name} {value:.3g}" for name, value in asked["margin"].items())
        return "\n\n".join(
            [
                plain(
                    "Certificate: moves that the shield allows, on the nominal machine",
                    "lattice | configurations | moves | harmful | dead ends", looked,
                ),
                plain(
                    "An adversary on machines that err, by the bounds of their errors",
                    "errors | shield | moves | collisions | singular", harms,
                ),
                plain(
                    f"Price: {asked['seeds']} seeds, {asked['episodes']} validation starts each",
                    "policy | its masks | shield | success (%) | holes | time to the first (s) | "
                    "harmful moves | interventions", costs,
                ),
                plain(
                    f"The same in contact, level `{LEVEL}`, by increments",
                    "policy | shield | success (%) | force or snap | interventions", touched,
                ),
                *_other_machines(parts),
                f"Mean ± std over seeds, of means an episode; a harmful move collides, or ends the "
                f"episode by a singularity. Margins (rad, m): {margin}. {source(result)}",
            ]
        )  # fmt: skip
