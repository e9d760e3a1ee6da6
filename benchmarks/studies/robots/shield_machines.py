"""Whether a shield's certificate holds on other machines, and on the worst within its bounds.

Machines are drawn from what the environment accepts; of each, moves are looked at that start where
the robots may meet. A machine within bounds of its errors stands at one of their corners, and is
asked where the shield's model stands at the margin.
"""

from __future__ import annotations

import math
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.protocol.seeding import derive
from benchmarks.studies.base import Tick
from coop_env import CoopInsertionEnv, SimToReal
from coop_env.errors import ResetOptionError
from coop_env.geometry import DELTA, OPTIMIZED
from coop_env.shield import KinematicShield
from coop_env.shield.certificate import NOTHING, check_product, lattice, near_points
from coop_env.simulation import dynamics
from coop_env.simulation.insertion_task import PAPER_TASK
from coop_env.simulation.state import VALID

Floats = NDArray[np.float64]

ERRORS: Final = {
    "1 mm, 0.1 degrees, links 0.02 %": SimToReal(
        base_position_error=0.001, base_tilt_error=math.radians(0.1), link_length_error=0.0002
    ),
    "2 mm, 0.2 degrees, links 0.05 %, play 0.05 degrees": SimToReal(
        base_position_error=0.002, base_tilt_error=math.radians(0.2), link_length_error=0.0005,
        backlash=math.radians(0.05),
    ),
}  # fmt: skip
"""Bounds of what the machine does not know of itself: base, its tilt, lengths, joints."""

MOVES: Final = 10_000  # of each machine
CONFIGURATIONS: Final = 2_000  # at the margin
LOOKS: Final = 23  # at each way
SAMPLE: Final = 40  # points of each robot at a time
BODIES: Final = ("dome_radius", "effector_radius", "forearm_radius", "spoke_radius", "limb_radius")
STEPS: Final = ("linear_step", "angular_step", "heave_step")


def draw_machine(rng: np.random.Generator) -> CoopInsertionEnv:
    """A machine that can be built and started: links by up to 1.2 times, bodies by up to 4.

    The peg is down to 20 times shorter or 1.5 times longer, steps are from half to twice as large.
    """

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
                geometry={**OPTIMIZED.as_dict(), **links},
                delta={**DELTA.as_dict(), **arms, **peg, **scaled(DELTA, ("peg_radius",), 3.0)},
                task=task,
            )
            KinematicShield(env)
            env.reset(seed=int(rng.integers(2**31)))
        except (ValueError, ResetOptionError):
            continue
        return env


def attack(env: CoopInsertionEnv, moves: int, rng: np.random.Generator) -> dict[str, int]:
    """Certified moves of a machine where its robots may meet, and how many of them harm.

    Every other time they start over the dome, where the Delta has just come low enough.
    """
    shield, result = KinematicShield(env), NOTHING
    middle, steps = env.configuration, np.array(env.task.steps)
    for number in range(200):
        delta, rrs = lattice(env.params, middle + steps * rng.uniform(-0.5, 0.5, len(steps)))
        near = delta[near_points(shield, env.params, delta)]
        if number % 2 and len(near):
            over = np.hypot(near[:, 0], near[:, 1]) < env.task.dome_radius
            room = env.params.rrs.heave_max - env.params.rrs.heave_min + 3.0 * steps[2]
            near = near[over & (near[:, 2] > near[:, 2].max() - room)]
        if len(near) and len(rrs):
            one, other = (part[rng.integers(len(part), size=SAMPLE)] for part in (near, rrs))
            result += check_product(shield, env.params, one, other, looks=LOOKS)
        if result.moves >= moves:
            break
    return {"moves": result.moves, "harmful": result.harmful}


def search(machines: int, tick: Tick) -> dict[str, int]:
    """The attack on so many machines, all together."""
    total = {"machines": machines, "moves": 0, "harmful": 0}
    for number in range(machines):
        rng = np.random.default_rng(derive("fresh", 16, number))
        result = attack(draw_machine(rng), MOVES, rng)
        total |= {key: total[key] + value for key, value in result.items()}
        tick((number + 1) / machines)
    return total


def at_the_margin(real: SimToReal, configurations: int) -> dict[str, int]:
    """Configurations driven to the margin, and at how many the worst machine in bounds is harmed.

    The base stands off by the whole bound along all axes and is tilted by it about both; all links
    are too long or too short by it.
    """
    env = CoopInsertionEnv(sim_to_real=real)
    shield, rng = KinematicShield(env), np.random.default_rng(derive("fresh", 17))
    bounds = np.array([real.base_position_error] * 3 + [real.base_tilt_error] * 2)
    corners = [bounds * signs for signs in product((-1.0, 1.0), repeat=len(bounds))]
    result = {"configurations": 0, "harmed": 0}
    while result["configurations"] < configurations:
        try:
            env.reset(seed=int(rng.integers(2**31)), options={"configuration": _edge(shield, rng)})
        except ResetOptionError:
            continue  # this draw of the machine is harmed already, or no start
        worst = product(corners, (-real.link_length_error, real.link_length_error))
        result["configurations"] += 1
        result["harmed"] += any(_status(env, base, longer) != VALID for base, longer in worst)
    return result


def _edge(shield: KinematicShield, rng: np.random.Generator) -> Floats:
    """A certified configuration from which the way on is not."""
    low = np.array([-0.12, -0.12, -0.60, -0.6, -0.6, 0.21])
    high = np.array([0.12, 0.12, -0.45, 0.6, 0.6, 0.25])
    while True:
        c = rng.uniform(low, high)
        if shield.is_certified(c):
            taken, changed = shield.certify(c, np.array([0.0, 0.0, -0.1, 0.0, 0.0, 0.0]))
            if changed:
                return np.asarray(c + taken)


def _status(env: CoopInsertionEnv, base: Floats, longer: float) -> int:
    """How a configuration is for a machine whose base stands so, and whose links are so long."""
    states = env._states.copy()
    machine = states[0]["machine"]
    r, d = env.params.rrs, env.params.delta
    machine["base"] = base
    machine["lengths"] = (1.0 + longer) * np.array(
        [r.base_radius, r.proximal_length, r.platform_radius, r.distal_length,
         d.base_radius, d.effector_radius, d.proximal_length, d.distal_length]
    )  # fmt: skip
    return int(dynamics.settle(states[0], env.params))
