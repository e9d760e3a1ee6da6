"""``python -m benchmarks study shield`` measures, goes on where it stopped, and can be checked."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from benchmarks.studies.robots import shield
from benchmarks.studies.robots.shield import ERRORS, Shield, at_the_margin, attack, draw_machine
from coop_env import CoopInsertionEnv
from coop_env.shield import KinematicShield
from coop_env.shield.certificate import Certificate, check_product, lattice
from coop_env.simulation.state import VALID

SMALL = ["--phases", "1", "--moves", "100", "--episodes", "1", "--seeds", "2", "--no-full"]
SMALL += ["--machines", "1"]


def test_the_command_goes_on_and_can_be_checked(site: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    here = site("shield")
    monkeypatch.setattr(shield, "CONFIGURATIONS", 20)
    monkeypatch.setattr(shield, "MOVES", 500)
    words = ["--results", str(here.results), *SMALL]
    with monkeypatch.context() as patched:
        patched.setattr(shield, "harm_of", _interrupted)
        with pytest.raises(KeyboardInterrupt):
            Shield.main(words)
    with monkeypatch.context() as patched:
        patched.setattr(shield, "prices", _interrupted)  # was done before
        assert Shield.main(words) == 0
    here.check(Shield, "Certificate")
    parts = here.parts(Shield)
    assert parts["certificate"]["sampled"]["harmful"] == 0
    for name in ERRORS:
        assert parts[f"{name}: shielded"]["collisions"] == 0
        assert parts[f"{name}: shielded"]["moves"] == 100
    bare, guarded = (row for row in parts["prices"] if row["masks"] == "paper's")
    assert sum(bare["harm"]) > 0.0
    assert guarded["harm"] == [0.0, 0.0]
    assert max(guarded["interventions"]) > 0.0


def _interrupted(*_: object) -> None:
    raise KeyboardInterrupt


@pytest.mark.slow
def test_a_certificate_finds_what_a_shield_without_margins_lets_through() -> None:
    """Between two looks of its own, and nowhere else, such a shield does not see."""
    env = CoopInsertionEnv(**shield.TASK)
    env.reset(seed=3)
    delta, rrs = lattice(env.params, env.configuration)
    rng = np.random.default_rng(0)
    low = delta[np.argsort(delta[:, 2])[: len(delta) // 2]]
    some = (low[rng.choice(len(low), 300)], rrs[rng.choice(len(rrs), 300)])
    kept = check_product(KinematicShield(env), env.params, *some)
    assert kept.points > 1000
    assert kept.harmful == 0
    nothing = dict.fromkeys(("sigma", "joint", "reach", "clearance"), 0.0)
    bold = check_product(KinematicShield(env, nothing), env.params, *some, looks=50)
    assert bold.points > kept.points
    assert bold.harmful > 0
    assert kept + kept == Certificate(*(2 * n for n in kept))


@pytest.mark.parametrize(
    "machine", [{"delta": {"peg_length": 0.005}}, {"task": {"effector_radius": 0.12}}, None]
)
def test_no_certified_move_harms_another_machine(machine: dict[str, Any] | None) -> None:
    """A short peg hangs above all of the 3-RRS while the effector does not."""
    rng = np.random.default_rng(0)
    env = draw_machine(rng) if machine is None else CoopInsertionEnv(**machine)
    env.reset(seed=1)
    result = attack(env, 10_000, rng)
    assert result.moves >= 10_000
    assert result.harmful == 0


def test_the_margin_covers_the_worst_machine_within_its_bounds_and_no_worse_one() -> None:
    covered, beyond = (at_the_margin(real, 120, lambda _: None) for real in ERRORS.values())
    assert (covered["configurations"], covered["harmed"]) == (120, 0)
    assert covered["share"] > 1.0 > beyond["share"]
    assert beyond["harmed"] > 30


def test_the_worst_signs_of_the_errors_are_found() -> None:
    """At this configuration a machine collides whose links err in different directions."""
    real = dataclasses.replace(next(iter(ERRORS.values())), link_length_error=0.0002)
    env, rng = CoopInsertionEnv(sim_to_real=real), np.random.default_rng(0)
    c = [-0.0491010901, 0.0531938052, -0.4809915656, -0.4686801592, -0.3083953182, 0.2335715947]
    assert KinematicShield(env).is_certified(c)
    env.reset(seed=0, options={"configuration": c})
    bounds = shield._bounds(real)
    found = [shield._least_share(env, bounds, rng.choice([-1.0, 1.0], 13)) for _ in range(4)]
    share, signs = min(found, key=lambda each: each[0])
    assert share == pytest.approx(0.968, abs=2e-3)
    alike = np.concatenate([signs[:5], np.ones(8)])
    assert shield._status(env, signs * bounds) != VALID == shield._status(env, alike * bounds)
