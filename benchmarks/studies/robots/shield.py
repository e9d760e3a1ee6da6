"""What the shield is worth: a certificate over the lattice, an adversary, and its price.

The lattice through one start is checked in full, those through others in a sample: no move that the
shield allows may harm the nominal machine, on its way or at its end. Then the machine has errors
(`SimToReal`), and an adversary takes the allowed move that leaves the least margin. Random and
learned policies play validation starts with and without the shield. On machines drawn at random,
moves are checked that start where the robots may meet. Last, machines at the corners of their
errors' bounds stand where the shield's model is at the margin.
"""

import argparse
import math
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from itertools import islice, product
from operator import itemgetter
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from benchmarks.evaluation.model_files import load_model
from benchmarks.methods.episodes import Episode
from benchmarks.protocol.seeding import derive, episode_seeds
from benchmarks.reporting.stats import over_seeds
from benchmarks.reporting.tables.table import plain
from benchmarks.studies.base import Act, Measured, Part, Tick, count, episode, greedy, source
from coop_env import CoopInsertionEnv, SimToReal
from coop_env.errors import ResetOptionError
from coop_env.geometry import DELTA, OPTIMIZED
from coop_env.shield import KinematicShield, ShieldMargin, ShieldWrapper, certificate
from coop_env.shield.certificate import Certificate
from coop_env.simulation import dynamics
from coop_env.simulation.insertion_task import PAPER_TASK
from coop_env.simulation.state import VALID
from coop_env.simulation.task import N_AXES

TASK: Final[dict[str, Any]] = {"reward": "progress"}
SAFE: Final[dict[str, Any]] = {**TASK, "mask_singularities": True}
SAMPLE: Final = 30  # points of each robot, of a sampled lattice
LADDER: Final = (1.0, 1.3, 1.7, 2.2, 3.0, 4.0)  # what the adversary compares, in default margins
# learned policies: their name in the table, and their runs
LEARNED: Final = {
    "Rainbow": "cut/runs/rainbow-optimized-safe",
    "Rainbow trained with it": "shielded/runs/rainbow-optimized-shielded",
}
Floats = NDArray[np.float64]
Maker = Callable[[CoopInsertionEnv, int], Act]  # makes a policy for an environment, from a seed
ERRORS: Final = {
    "1 mm, 0.1 degrees, links 0.01 %": SimToReal(
        base_position_error=0.001, base_tilt_error=math.radians(0.1), link_length_error=0.0001
    ),
    "2 mm, 0.2 degrees, links 0.05 %, play 0.05 degrees": SimToReal(
        base_position_error=0.002, base_tilt_error=math.radians(0.2), link_length_error=0.0005,
        backlash=math.radians(0.05),
    ),
}  # fmt: skip
"""Bounds of the machine's unknown errors: base, its tilt, lengths, joints."""

MOVES: Final = 10_000  # of each machine
CONFIGURATIONS: Final = 10_000  # at the margin
CLIMB: Final = 100  # of them in a row
LOOKS: Final = 23  # at each way
NEAR: Final = 40  # points of each robot at a time, where they may meet
BODIES: Final = ("dome_radius", "effector_radius", "forearm_radius", "spoke_radius", "limb_radius")
STEPS: Final = ("linear_step", "angular_step", "heave_step")


def adversary(env: CoopInsertionEnv) -> Act:
    """A policy that takes the allowed move after which the least margin is left."""
    rng, unit = np.random.default_rng(derive("fresh", 14)), asdict(ShieldMargin())
    margins = [{name: m * size for name, size in unit.items()} for m in LADDER]
    shields = [KinematicShield(env, margin) for margin in margins]

    def act(observation: Any, masks: Any) -> int:
        left = np.full(len(masks), np.inf)
        for move in np.flatnonzero(masks).tolist():
            to = env.configuration
            to[move // 2] += shields[0].steps[move // 2] * (1 - 2 * (move % 2))
            left[move] = sum(shield.is_certified(to) for shield in shields)
        return int(rng.choice(np.flatnonzero(left == left.min())))

    return act


def _at_random(env: CoopInsertionEnv, seed: int) -> Act:
    rng = np.random.default_rng(derive("fresh", 15, seed))
    return lambda observation, masks: int(rng.choice(np.flatnonzero(masks)))


def certificates(phases: int, in_full: bool, tick: Tick) -> dict[str, Any]:
    """The lattice of one start in full, and samples of ``phases`` others."""
    env, result = CoopInsertionEnv(**TASK), {}
    shield = KinematicShield(env)
    env.reset(seed=derive("validate", 0, 0))
    if in_full:
        lattice = (env.params, env.configuration)
        full = certificate.certify_lattice(shield, *lattice, lambda share: tick(share / 2))
        result["full"] = full._asdict()
    sampled, rng = certificate.NOTHING, np.random.default_rng(derive("fresh", 13))
    for phase in range(phases):
        env.reset(seed=derive("validate", 1, phase))
        robots = certificate.lattice(env.params, env.configuration)
        delta, rrs = (part[rng.choice(len(part), SAMPLE, replace=False)] for part in robots)
        sampled += certificate.check_product(shield, env.params, delta, rrs)
        tick(0.5 + 0.5 * (phase + 1) / phases)
    return {**result, "sampled": sampled._asdict()}


def harm_of(real: SimToReal, moves: int, shielded: bool, tick: Tick) -> dict[str, int]:
    """Collisions and singular ends in ``moves`` moves of the adversary."""
    env = CoopInsertionEnv(**SAFE, sim_to_real=real)
    player: Any = ShieldWrapper(env) if shielded else env
    choose, result = adversary(env), {"moves": 0, "collisions": 0, "singular": 0, "episodes": 0}
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
    """A row for random and each stored policy, by masks, with and without the shield."""

    def policy(runs: str, env: CoopInsertionEnv, seed: int) -> Act:
        return greedy(load_model(results / f"{runs}-s{seed}" / "policy.zip"))

    players: dict[str, Maker] = {"random": _at_random}
    for name, runs in LEARNED.items():
        if (results / f"{runs}-s0" / "policy.zip").is_file():
            players[name] = partial(policy, runs)
    rows: list[dict[str, Any]] = []
    for name, masks, shielded in product(players, ("paper's", "safe"), (False, True)):
        of = (players[name], SAFE if masks == "safe" else TASK, shielded)
        result = [price_of(*of, seed, episodes) for seed in range(seeds)]
        numbers = {key: [one[key] for one in result] for key in result[0]}
        rows.append({"policy": name, "masks": masks, "shield": shielded, **numbers})
        tick(len(rows) / (4 * len(players)))
    return rows


def draw_machine(rng: np.random.Generator) -> CoopInsertionEnv:
    """A random valid machine, far from the paper's in links, bodies and steps."""

    def scaled(one: object, names: tuple[str, ...], factor: float) -> dict[str, float]:
        return {name: getattr(one, name) * factor ** rng.uniform(-1.0, 1.0) for name in names}

    while True:
        links = scaled(OPTIMIZED, ("base_radius", "proximal_length", "platform_radius"), 1.1)
        arms = scaled(DELTA, ("base_radius", "effector_radius", "proximal_length"), 1.2)
        peg = {"peg_length": DELTA.peg_length * 20.0 ** rng.uniform(-1.0, 0.15),
               "base_height": DELTA.base_height * rng.uniform(0.8, 1.1)}  # fmt: skip
        task = scaled(PAPER_TASK, BODIES, 4.0) | scaled(PAPER_TASK, STEPS, 2.0)
        try:
            env = CoopInsertionEnv(
                geometry={**asdict(OPTIMIZED), **links},
                delta={**asdict(DELTA), **arms, **peg, **scaled(DELTA, ("peg_radius",), 3.0)},
                task=task,
            )
            KinematicShield(env)
            env.reset(seed=int(rng.integers(2**31)))
        except (ValueError, ResetOptionError):
            continue
        return env


def attack(env: CoopInsertionEnv, moves: int, rng: np.random.Generator) -> Certificate:
    """Certified moves of a machine where its robots may meet.

    Every other time they start over the dome, where the Delta has just come low enough.
    """
    shield, result = KinematicShield(env), certificate.NOTHING
    middle, steps = env.configuration, np.array(env.task.steps)
    for number in range(200):
        near_middle = middle + steps * rng.uniform(-0.5, 0.5, len(steps))
        delta, rrs = certificate.lattice(env.params, near_middle)
        near = delta[certificate.near_points(shield, env.params, delta)]
        if number % 2 and len(near):
            over = np.hypot(near[:, 0], near[:, 1]) < env.task.dome_radius
            room = env.params.rrs.heave_max - env.params.rrs.heave_min + 3.0 * steps[2]
            near = near[over & (near[:, 2] > near[:, 2].max() - room)]
        if len(near) and len(rrs):
            one, other = (part[rng.integers(len(part), size=NEAR)] for part in (near, rrs))
            result += certificate.check_product(shield, env.params, one, other, looks=LOOKS)
        if result.moves >= moves:
            break
    return result


def search(machines: int, tick: Tick) -> dict[str, int]:
    """The attack on ``machines`` machines, summed."""
    total = certificate.NOTHING
    for number in range(machines):
        rng = np.random.default_rng(derive("fresh", 16, number))
        total += attack(draw_machine(rng), MOVES, rng)
        tick((number + 1) / machines)
    return {"machines": machines, "moves": total.moves, "harmful": total.harmful}


def at_the_margin(real: SimToReal, configurations: int, tick: Tick) -> dict[str, float]:
    """Configurations at the margin, and at how many the worst machine in bounds is harmed.

    Each error is at its bound, with the worst sign. All errors are scaled together up to the first
    harm: the least such ``share`` of the bounds says how much is covered. In each run of ``CLIMB``
    configurations all but the first are near the one with the least share.
    """
    env, bounds = CoopInsertionEnv(sim_to_real=real), _bounds(real)
    shield, rng = KinematicShield(env), np.random.default_rng(derive("fresh", 17))
    result = {"configurations": 0, "harmed": 0, "share": math.inf}
    best, least, signs = np.zeros(N_AXES), math.inf, np.ones(len(bounds))
    while result["configurations"] < configurations:
        begins = result["configurations"] % CLIMB == 0
        c = _edge(shield, rng, None if begins else best)
        try:
            env.reset(seed=int(rng.integers(2**31)), options={"configuration": c})
        except ResetOptionError:
            continue  # this draw of the machine is harmed already, or no start
        guesses = list(rng.choice([-1.0, 1.0], (8 if begins else 1, len(bounds))))
        guesses += [] if begins else [signs]
        share, worst = min(
            (_least_share(env, bounds, guess) for guess in guesses), key=itemgetter(0)
        )
        if begins or share < least:
            best, least, signs = c, share, worst
        result["configurations"] += 1
        result["harmed"] += share <= 1.0
        result["share"] = min(result["share"], share)
        tick(result["configurations"] / configurations)
    return result


def _bounds(real: SimToReal) -> Floats:
    """Bounds of the base's position (3) and tilt (2), and of the eight lengths."""
    base = [real.base_position_error] * 3 + [real.base_tilt_error] * 2
    return np.array([*base, *[real.link_length_error] * 8])


def _edge(shield: KinematicShield, rng: np.random.Generator, near: Floats | None) -> Floats:
    """A certified configuration at the edge of what is certified, anywhere or ``near`` another."""
    low = np.array([-0.12, -0.12, -0.60, -0.6, -0.6, 0.21])
    span = np.array([0.12, 0.12, -0.45, 0.6, 0.6, 0.25]) - low
    while True:
        c = low + span * rng.random(N_AXES)
        if near is not None:
            c = near + 0.5 * span * 0.1 ** rng.uniform(0.5, 3.0) * rng.normal(size=N_AXES)
        if shield.is_certified(c):
            down = np.array([0.0, 0.0, -0.1, 0.0, 0.0, 0.0])
            way = down if rng.random() < 0.3 else 0.3 * span * rng.normal(size=N_AXES)
            taken, changed = shield.certify(c, way)
            if changed:
                return np.asarray(c + taken)


def _least_share(env: CoopInsertionEnv, bounds: Floats, signs: Floats) -> tuple[float, Floats]:
    """The least share of all bounds that harms the machine, at most 8, and the errors' signs.

    From the given signs on, signs are flipped one by one as long as that lowers the share.
    """

    def harms(share: float, signs: Floats) -> bool:
        return _status(env, share * signs * bounds) != VALID

    def first(signs: Floats, most: float) -> float:
        low, high = 0.0, most
        for _ in range(12):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if harms(middle, signs) else (middle, high)
        return high

    least, turned = first(signs, 8.0), True
    while turned:
        turned = False
        for k in range(len(signs)):
            other = signs.copy()
            other[k] *= -1.0
            if harms(least, other):
                smaller = first(other, least)
                turned, signs = turned or smaller < least, other
                least = min(least, smaller)
    return least, signs


def _status(env: CoopInsertionEnv, errors: Floats) -> int:
    """Status of the configuration on a machine with these errors of base (5) and lengths (8)."""
    states = env._states.copy()
    machine = states[0]["machine"]
    machine["base"] = errors[:5]
    machine["lengths"] = (1.0 + errors[5:]) * np.array([*env.params.rrs[:4], *env.params.delta[:4]])
    return int(dynamics.settle(states[0], env.params))


def _numbers(row: dict[str, Any]) -> list[str]:
    """Mean and standard deviation over seeds of a row of the prices."""
    digits = {"success": 1, "holes": 2, "time": 1, "harm": 2, "interventions": 1}
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
        parts: dict[str, Part] = {
            "prices": partial(prices, given.results, given.episodes, given.seeds),
            "certificate": partial(certificates, given.phases, given.full),
        }
        for name, real in ERRORS.items():
            parts[f"{name}: bare"] = partial(harm_of, real, max(1, given.moves // 100), False)
            parts[f"{name}: shielded"] = partial(harm_of, real, given.moves, True)
        parts["machines"] = partial(search, given.machines)
        for name, real in ERRORS.items():
            parts[f"{name}: margin"] = partial(at_the_margin, real, CONFIGURATIONS)
        return parts

    @staticmethod
    def to_markdown(result: dict[str, Any]) -> str:
        """The measurements as Markdown."""
        asked, parts, yes_no = result["asked"], result["parts"], {False: "no", True: "yes"}

        def counts(part: dict[str, int], names: str) -> list[str]:
            return [f"{part[name]:,}" for name in names.split()]

        names = {"full": "one start's, in full", "sampled": f"{asked['phases']:,} starts', sampled"}
        units = {"joint": " rad", "clearance": " m"}
        margin = ", ".join(f"{k} {v:.3g}{units.get(k, '')}" for k, v in asked["margin"].items())
        lattices = [
            [names[key], *counts(one, "points moves harmful dead_ends")]
            for key, one in parts["certificate"].items()
        ]
        attacks = [
            [name, shield, *counts(parts[f"{name}: {way}"], "moves collisions singular")]
            for name in ERRORS
            for way, shield in (("bare", "no"), ("shielded", "yes"))
        ]
        paid = [
            [row["policy"], row["masks"], yes_no[row["shield"]], *_numbers(row)]
            for row in parts["prices"]
            if row["policy"] != "adversary"  # of older files
        ]
        machines = [counts(parts["machines"], "machines moves harmful")]
        margins = [
            [name, *counts(part := parts[f"{name}: margin"], "configurations harmed"),
             f"{part['share']:.2f}"]
            for name in ERRORS
        ]  # fmt: skip
        tables = [
            plain("Certificate: moves that the shield allows, on the nominal machine",
                  "lattice | configurations | moves | harmful | dead ends", lattices),
            plain("An adversary on machines that err, by the bounds of their errors",
                  "errors | shield | moves | collisions | singular", attacks),
            plain(f"Price: {asked['seeds']} seeds, {asked['episodes']} validation starts each",
                  "policy | its masks | shield | success (%) | holes | time to the first (s) | "
                  "harmful moves | interventions", paid),
            plain("Random machines: moves that the shield allows where the robots may meet",
                  "machines | moves | harmful", machines),
            plain("The worst machine within the bounds of its errors, its model at the margin",
                  "errors | configurations | harmed | least share of the bounds found to harm",
                  margins),
        ]  # fmt: skip
        note = (
            "Mean ± std over seeds, of means an episode; a harmful move collides, or ends the "
            f"episode by a singularity. Margins: {margin}. {source(result)}"
        )
        return "\n\n".join([*tables, note])
