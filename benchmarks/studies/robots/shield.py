"""What the shield is worth: a certificate over the lattice, an adversary, and its price.

    python -m benchmarks study shield

The lattice through one start state is looked at in full, and so many others in a sample: no move
that the shield allows may harm the nominal machine, on its way or at its end. Then the machine errs
(`SimToReal`), and an adversary takes of the allowed moves one with the least margins left. Last,
random and learned policies play validation starts with and without the shield: its interventions,
and what it costs. Random machines are looked at too, and the worst within their bounds.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from itertools import islice, product
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from benchmarks.evaluation.model_files import load_model
from benchmarks.methods.episodes import Episode
from benchmarks.protocol.seeding import derive, episode_seeds
from benchmarks.reporting.stats import over_seeds
from benchmarks.reporting.tables.table import plain
from benchmarks.studies.base import Act, Measured, Part, Tick, count, episode, greedy, source
from benchmarks.studies.robots.shield_machines import CONFIGURATIONS, ERRORS, at_the_margin, search
from coop_env import CoopInsertionEnv, SimToReal
from coop_env.shield import KinematicShield, ShieldMargin, ShieldWrapper
from coop_env.shield.certificate import NOTHING, certify_lattice, check_product, lattice

TASK: Final[dict[str, Any]] = {"reward": "progress"}
SAFE: Final[dict[str, Any]] = {**TASK, "mask_singularities": True}
SAMPLE: Final = 30  # points of each robot, of a sampled lattice
LADDER: Final = (1.0, 1.3, 1.7, 2.2, 3.0, 4.0)  # the adversary measures what is left in margins
# learned policies: their name in the table, and their runs
LEARNED: Final = {
    "Rainbow": "cut/runs/rainbow-optimized-safe",
    "Rainbow trained with it": "shielded/runs/rainbow-optimized-shielded",
}
Maker = Callable[[CoopInsertionEnv, int], Act]  # who plays in an environment, of that seed


class Adversary:
    """Takes, of the moves it may, one after which the least of the margins is left."""

    def __init__(self, env: CoopInsertionEnv, rng: np.random.Generator) -> None:
        self._env, self._rng, unit = env, rng, asdict(ShieldMargin())
        self._shields = [
            KinematicShield(env, {name: m * size for name, size in unit.items()}) for m in LADDER
        ]

    def __call__(self, observation: Any, masks: Any) -> int:
        """The move."""
        left = np.full(len(masks), np.inf)
        for move in np.flatnonzero(masks).tolist():
            to = self._env.configuration
            to[move // 2] += self._shields[0].steps[move // 2] * (1 - 2 * (move % 2))
            left[move] = sum(shield.is_certified(to) for shield in self._shields)
        return int(self._rng.choice(np.flatnonzero(left == left.min())))


def _at_random(env: CoopInsertionEnv, seed: int) -> Act:
    rng = np.random.default_rng(derive("fresh", 15, seed))
    return lambda observation, masks: int(rng.choice(np.flatnonzero(masks)))


def certificates(phases: int, in_full: bool, tick: Tick) -> dict[str, Any]:
    """The lattice of one start in full, and samples of so many others."""
    env, result = CoopInsertionEnv(**TASK), {}
    shield = KinematicShield(env)
    env.reset(seed=derive("validate", 0, 0))
    if in_full:
        full = certify_lattice(shield, env.params, env.configuration, lambda share: tick(share / 2))
        result["full"] = full._asdict()
    sampled, rng = NOTHING, np.random.default_rng(derive("fresh", 13))
    for phase in range(phases):
        env.reset(seed=derive("validate", 1, phase))
        robots = lattice(env.params, env.configuration)
        delta, rrs = (part[rng.choice(len(part), SAMPLE, replace=False)] for part in robots)
        sampled += check_product(shield, env.params, delta, rrs)
        tick(0.5 + 0.5 * (phase + 1) / phases)
    return {**result, "sampled": sampled._asdict()}


def harm_of(real: SimToReal, moves: int, shielded: bool, tick: Tick) -> dict[str, int]:
    """Collisions and singular ends in so many of the adversary's moves."""
    env = CoopInsertionEnv(**SAFE, sim_to_real=real)
    player: Any = ShieldWrapper(env) if shielded else env
    choose = Adversary(env, np.random.default_rng(derive("fresh", 14)))
    result = {"moves": 0, "collisions": 0, "singular": 0, "episodes": 0}
    while result["moves"] < moves:
        start = derive("validate", 2, result["episodes"])
        steps = episode(player, lambda seen: choose(seen, player.action_masks()), seed=start)
        for info in islice(steps, 1, 1 + moves - result["moves"]):
            result["moves"] += 1
            result["collisions"] += bool(info["collision"])
            result["singular"] += bool(info["singular"])
        result["episodes"] += 1
        tick(result["moves"] / moves)
    return result


def price_of(
    make: Maker, arguments: dict[str, Any], shielded: bool, seed: int, episodes: int
) -> dict[str, float]:
    """A policy on validation starts: success, time, harm and interventions, means an episode.

    An intervention is a choice that the shield forbids; the policy then chooses under its masks.
    """
    env = CoopInsertionEnv(**arguments)
    shield, choose, changed = ShieldWrapper(env), make(env, seed), 0

    def act(observation: Any) -> Any:
        nonlocal changed
        action, masks = choose(observation, env.action_masks()), shield.action_masks()
        if not shielded or masks[action]:
            return action
        changed += 1
        return choose(observation, masks)

    rows = []
    for number, start in enumerate(episode_seeds(seed, episodes, "validate")):
        played = Episode(env, number, start)
        while not played.over:
            played.move(act(played.observation))
        rows.append(played.row())
    mean = pd.DataFrame(rows).mean(numeric_only=True)
    return {
        "success": 100.0 * float(mean["success"]),
        "holes": float(mean["holes"]),
        "time": float(mean["time_first"]),
        "harm": float(mean["collisions"] + mean["singular"]),
        "interventions": changed / episodes,
    }


def prices(results: Path, episodes: int, seeds: int, tick: Tick) -> list[dict[str, Any]]:
    """Who plays, under which masks of its own, and what the shield changes, over seeds.

    Learned policies that are not among the results are left out.
    """

    def policy(runs: str, env: CoopInsertionEnv, seed: int) -> Act:
        return greedy(load_model(results / f"{runs}-s{seed}" / "policy.zip"))

    players: list[tuple[str, str, Maker]] = [
        ("random", "paper's", _at_random),
        ("random", "safe", _at_random),
    ]
    for name, runs in LEARNED.items():
        if (results / f"{runs}-s0" / "policy.zip").is_file():
            players += [(name, masks, partial(policy, runs)) for masks in ("paper's", "safe")]
    rows: list[dict[str, Any]] = []
    for (name, masks, make), shielded in product(players, (False, True)):
        arguments = SAFE if masks == "safe" else TASK
        result = [price_of(make, arguments, shielded, seed, episodes) for seed in range(seeds)]
        numbers = {key: [one[key] for one in result] for key in result[0]}
        rows.append({"policy": name, "masks": masks, "shield": shielded, **numbers})
        tick(len(rows) / (2 * len(players)))
    return rows


def _numbers(row: dict[str, Any], digits: dict[str, int]) -> list[str]:
    """Mean and standard deviation over seeds of what a row has, with so many digits of each."""
    values = {key: over_seeds(row[key]) for key in digits if key in row}
    return [value.text(digits[key]) if value.n > 1 else "-" for key, value in values.items()]


class Shield(Measured):
    """The shield: its certificate, an adversary, its price, other machines."""

    name, file = "shield", "shield/shield.json"
    options = {  # noqa: RUF012
        "--phases": count(1000, "sampled lattices"),
        "--moves": count(1_000_000, "the adversary's, on each machine"),
        "--episodes": count(20, "of each policy and seed"),
        "--seeds": count(5, "number of seeds", 2),
        "--full": {
            **{"action": argparse.BooleanOptionalAction, "default": True},
            "help": "one lattice in full",
        },
        "--machines": count(20, "random machines"),
    }

    def asked(self) -> dict[str, Any]:
        return super().asked() | {"margin": asdict(ShieldMargin())}

    def measures(self) -> dict[str, Part]:
        given = self.given
        ways = {"bare": (max(1, given.moves // 100), False), "shielded": (given.moves, True)}
        return {
            "prices": partial(prices, given.results, given.episodes, given.seeds),
            "certificate": partial(certificates, given.phases, given.full),
            **{
                f"{name}: {way}": partial(harm_of, real, *of_way)
                for name, real in ERRORS.items()
                for way, of_way in ways.items()
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
        asked, parts, said = result["asked"], result["parts"], {False: "no", True: "yes"}

        def counts(part: dict[str, int], names: str) -> list[str]:
            return [f"{part[name]:,}" for name in names.split()]

        names = {"full": "one start's, in full", "sampled": f"{asked['phases']:,} starts', sampled"}
        digits = {"success": 1, "holes": 2, "time": 1, "harm": 2, "interventions": 1}
        margin = ", ".join(f"{name} {value:.3g}" for name, value in asked["margin"].items())
        tables = [
            plain(
                "Certificate: moves that the shield allows, on the nominal machine",
                "lattice | configurations | moves | harmful | dead ends",
                [
                    [names[key], *counts(one, "points moves harmful dead_ends")]
                    for key, one in parts["certificate"].items()
                ],
            ),
            plain(
                "An adversary on machines that err, by the bounds of their errors",
                "errors | shield | moves | collisions | singular",
                [
                    [name, shield, *counts(parts[f"{name}: {way}"], "moves collisions singular")]
                    for name in ERRORS
                    for way, shield in (("bare", "no"), ("shielded", "yes"))
                ],
            ),
            plain(
                f"Price: {asked['seeds']} seeds, {asked['episodes']} validation starts each",
                "policy | its masks | shield | success (%) | holes | time to the first (s) | "
                "harmful moves | interventions",
                [
                    [row["policy"], row["masks"], said[row["shield"]], *_numbers(row, digits)]
                    for row in parts["prices"]
                    if row["policy"] != "adversary"  # of older files
                ],
            ),
            plain(
                "Random machines: moves that the shield allows where the robots may meet",
                "machines | moves | harmful",
                [counts(parts["machines"], "machines moves harmful")],
            ),
            plain(
                "The worst machine within the bounds of its errors, its model at the margin",
                "errors | configurations | harmed",
                [[n, *counts(parts[f"{n}: margin"], "configurations harmed")] for n in ERRORS],
            ),
        ]
        note = (
            "Mean ± std over seeds, of means an episode; a harmful move collides, or ends the "
            f"episode by a singularity. Margins (rad, m): {margin}. {source(result)}"
        )
        return "\n\n".join([*tables, note])
