"""What the shield certifies keeps its margins, and it takes away no more than it must."""

import pickle
from dataclasses import asdict
from itertools import islice, product
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_checker import check_env

from coop_env import CoopInsertionEnv, SimToReal
from coop_env.errors import ActionError, ArgumentError, StateError
from coop_env.geometry import OPTIMIZED
from coop_env.kinematics import rrs
from coop_env.shield import (
    KinematicShield,
    ShieldedInsertionEnv,
    ShieldedInsertionVecEnv,
    ShieldMargin,
    ShieldWrapper,
    certificate,
)
from coop_env.shield.certificate import certify_lattice
from coop_env.simulation.collision import below_ceiling
from coop_env.simulation.state import VALID
from coop_env.simulation.task import axis_bounds
from tests.coop_env.moves import MOVES

COLLISION = 2


@pytest.fixture(scope="module")
def env() -> CoopInsertionEnv:
    return CoopInsertionEnv()


@pytest.fixture(scope="module")
def shield(env: CoopInsertionEnv) -> KinematicShield:
    return KinematicShield(env)


@pytest.fixture(scope="module")
def near(shield: KinematicShield) -> np.ndarray:
    """Certified configurations (n, 6), most of them near the dome or near a limit."""
    low, high = [-0.12, -0.12, -0.60, -0.7, -0.7, 0.21], [0.12, 0.12, -0.45, 0.7, 0.7, 0.25]
    drawn = np.random.default_rng(1).uniform(low, high, (20_000, 6))
    return np.array(list(islice(filter(shield.is_certified, drawn), 400)))


def test_another_body_a_clearance_away_touches_nothing(
    env: CoopInsertionEnv, shield: KinematicShield, near: np.ndarray
) -> None:
    """The Delta moved by less than the clearance in any direction is still free."""
    rng = np.random.default_rng(2)

    def touches(c: np.ndarray) -> bool:
        to = rng.normal(size=3)
        shift = 0.999 * shield.margin.clearance * to / np.linalg.norm(to)
        return env.configuration_status(c + np.append(shift, np.zeros(3))) == COLLISION

    assert not any(touches(c) for c in near)
    bold = KinematicShield(env, ShieldMargin(clearance=0.0))
    drawn = rng.uniform(near.min(axis=0), near.max(axis=0), (20_000, 6))
    assert any(touches(c) for c in drawn if bold.is_certified(c))  # so that the first could fail


def test_margins_lie_within_both_limits_and_the_tasks_own(env: CoopInsertionEnv) -> None:
    loose = ShieldMargin(sigma=0.01, joint=0.1).tighten(env.params)
    limits = OPTIMIZED.joint_min + 0.1, OPTIMIZED.joint_max - 0.1
    assert (loose.rrs.joint_min, loose.rrs.joint_max) == pytest.approx(limits)
    assert loose.layout["singular_margin"] == env.task.singular_margin


def test_increments_keep_to_the_way_and_to_the_margins(
    env: CoopInsertionEnv, shield: KinematicShield, near: np.ndarray
) -> None:
    rng = np.random.default_rng(3)
    changes = 0
    for c in near[:150]:
        a = rng.uniform(-1.0, 1.0, 6) * [0.05, 0.05, 0.05, 0.2, 0.2, 0.03]
        result, changed = shield.certify(c, a)
        changes += changed
        assert changed == bool((result != a).any())
        assert (result * np.sign(a) >= 0.0).all()
        assert (np.abs(result) <= np.abs(a)).all()
        way = c + np.outer(np.linspace(0.0, 1.0, 101), result)
        assert not any(env.configuration_status(there) for there in way)
        assert (rrs.signed_sigma_min(way[:, 3:], OPTIMIZED) > 0.069).all()
        assert shield.is_certified(c + result)
    assert 30 < changes < 150


def test_where_one_robot_is_stopped_the_other_moves_on(shield: KinematicShield) -> None:
    c = np.array([0.0, 0.0, -0.45, 0.0, 0.0, 0.21])
    a = np.array([0.01, 0.0, 0.0, 0.0, 0.0, -0.02])  # the platform stands at its lowest
    result, changed = shield.certify(c, a)
    assert changed
    np.testing.assert_allclose(result, [0.01, 0.0, 0.0, 0.0, 0.0, 0.0], atol=1e-12)


def test_moves_are_increments_that_need_no_change(
    env: CoopInsertionEnv, shield: KinematicShield, near: np.ndarray
) -> None:
    for c in near[:60]:
        expected = [not shield.certify(c, move)[1] for move in MOVES * env.task.steps]
        np.testing.assert_array_equal(shield.allowed_moves(c), expected)


def test_no_random_agent_does_harm_and_the_way_back_stays_open() -> None:
    wrapped = ShieldWrapper(CoopInsertionEnv())
    rng = np.random.default_rng(4)
    wrapped.reset(seed=1000)
    interventions, inside = 0, False
    for _ in range(1500):
        inside |= wrapped.shield.is_certified(wrapped._inner.configuration)
        assert not inside or wrapped.shield.allowed_moves(wrapped._inner.configuration).any()
        _, _, terminated, truncated, info = wrapped.step(int(rng.integers(12)))
        assert not info["singular"]
        assert not inside or not info["violation"]
        if terminated or truncated:
            interventions += info["interventions"]
            inside = False
            wrapped.reset()
    assert interventions > 50


def test_both_robots_at_once_are_looked_at_as_closely_as_one() -> None:
    env = CoopInsertionEnv()
    shield = KinematicShield(env, {"clearance": 0.001})
    state = [0.0187092662, -0.0294016203, -0.4540205698, 0.0437298204, -0.0988583605, 0.2239954829]
    action = [-0.0002102569, 0.0012755527, 0.0015260266, 0.0025472661, 0.0030840615, -0.002]
    assert shield.is_certified(state)
    taken, _ = shield.certify(state, action)
    for share in np.linspace(0.0, 1.0, 201):
        assert env.configuration_status(state + share * taken) == VALID


def test_masks_are_those_of_the_environment_and_of_the_shield() -> None:
    wrapped = ShieldWrapper(gym.make("CoopInsertion-v0", mask_visited=8))
    wrapped.reset(seed=3)
    wrapped.step(4)
    own = wrapped.env.unwrapped.action_masks()  # type: ignore[attr-defined]
    np.testing.assert_array_equal(
        wrapped.action_masks(), own & wrapped.shield.allowed_moves(wrapped._inner.configuration)
    )
    assert not wrapped.action_masks()[5]  # back to where it came from
    ways = wrapped._inner.configuration + MOVES * wrapped.shield.steps
    sigma = [rrs.signed_sigma_min(way[3:], OPTIMIZED) for way in ways]
    best = int(np.argmax(np.where(wrapped.action_masks(), sigma, -np.inf)))
    *_, info = wrapped.step(5)
    assert (info["shielded"], info["interventions"]) == (True, 1)
    np.testing.assert_allclose(wrapped._inner.configuration, ways[best], atol=1e-12)
    wrapped.reset(seed=3)
    assert wrapped.step(4)[-1]["interventions"] == 0
    own, inner = (
        np.array(masks) == 1
        for masks in ([[1, 1, 0], [1, 0, 0], [1, 0, 1]], [[0, 1, 1], [0, 1, 1], [0, 0, 0]])
    )
    assert wrapped.shield.masks(own, inner).tolist() == [
        [False, True, False], [False, True, True], [True, False, True]
    ]  # fmt: skip


def test_a_start_nearer_to_a_limit_than_the_margin_is_left_by_the_environments_own_masks() -> None:
    wrapped = ShieldWrapper(CoopInsertionEnv(), {"joint": 0.5})  # 9 of 66 degrees are left
    wrapped.reset(seed=0)
    own = wrapped.env.unwrapped.action_masks()  # type: ignore[attr-defined]
    assert not wrapped.shield.allowed_moves(wrapped._inner.configuration).any()
    np.testing.assert_array_equal(wrapped.action_masks(), own)


def test_the_wrapper_is_an_environment_of_its_own() -> None:
    wrapped = ShieldWrapper(CoopInsertionEnv())
    check_env(wrapped)
    named: Any = ShieldWrapper(gym.make("CoopInsertion-v0"), ShieldMargin(clearance=0.004))
    again = gym.make(gym.envs.registration.EnvSpec.from_json(named.spec.to_json()))
    assert again.get_wrapper_attr("shield").margin == named.shield.margin
    wrapped.reset(seed=5)
    twin = pickle.loads(pickle.dumps(wrapped))
    for action in (3, 4, 11, 0):
        one, two = wrapped.step(action), twin.step(action)
        np.testing.assert_array_equal(one[0], two[0])
        assert one[4]["interventions"] == two[4]["interventions"]


class TestContact:
    @pytest.fixture(autouse=True)
    def needs_mujoco(self) -> None:
        pytest.importorskip("mujoco", reason="needs the extra physics")

    @pytest.mark.parametrize(
        ("name", "options", "steps"),
        [
            ("CoopInsertionContact-v0", {"hole": 0}, [0.0005, 0.0005]),
            ("CoopInsertionPhysics-v0", {}, [0.005, 0.005, 0.005]),
        ],
    )
    def test_commands_stay_within_the_margins(
        self, name: str, options: dict[str, int], steps: list[float]
    ) -> None:
        wrapped = ShieldWrapper(gym.make(name), ShieldMargin(sigma=0.2))
        np.testing.assert_allclose(wrapped.shield.steps[: len(steps)], steps)
        # with contact the peg may reach into the dome
        assert wrapped.shield.is_certified([0.0, 0.0, -0.46, 0.0, 0.0, 0.22])
        wrapped.reset(seed=0, options=options)
        tilting = np.zeros(6, np.float32)
        tilting[3:5] = np.sign(wrapped._inner.configuration[3:5])  # on towards the singularity
        for _ in range(60):
            *_, terminated, _, info = wrapped.step(tilting)
            assert not info["violation"]
            assert not terminated
        assert info["interventions"] > 0
        assert rrs.signed_sigma_min(wrapped._inner.configuration[3:], OPTIMIZED) >= 0.2 - 1e-6

    def test_an_action_within_the_margins_passes_to_the_last_bit(self) -> None:
        plain, wrapped = (gym.make("CoopInsertionContact-v0") for _ in range(2))
        wrapped = ShieldWrapper(wrapped)
        plain.action_space.seed(0)
        plain.reset(seed=7)
        wrapped.reset(seed=7)
        for _ in range(3):
            action = plain.action_space.sample()
            one, two = plain.step(action), wrapped.step(action)
            np.testing.assert_array_equal(one[0], two[0])
            assert not two[4]["shielded"]

    def test_what_changes_actions_belongs_around_it(self) -> None:
        low, high = np.float32(-0.1), np.float32(0.1)
        inner = gym.wrappers.RescaleAction(gym.make("CoopInsertionContact-v0"), low, high)
        nested = gym.wrappers.RecordEpisodeStatistics(inner)
        with pytest.raises(ArgumentError, match="RescaleAction changes"):
            ShieldWrapper(nested)
        for env in (inner, gym.wrappers.RepeatAction(gym.make("CoopInsertion-v0"), 2)):
            with pytest.raises(ArgumentError, match=f"{type(env).__name__} changes"):
                ShieldWrapper(env)


@pytest.mark.parametrize(
    ("margin", "message"),
    [
        ({"sigma": -0.1}, r"ShieldMargin.sigma = -0.1"),
        ({"joint": 0.5, "sigma": "much"}, "ShieldMargin.sigma = 'much'"),
        ({"clearance": 0.05}, "closes the holes"),
        ({"slack": 1.0}, "slack"),
        (3.0, "margin = 3.0"),
    ],
)
def test_margins_that_make_no_sense(env: CoopInsertionEnv, margin: Any, message: str) -> None:
    with pytest.raises(ArgumentError, match=message):
        KinematicShield(env, margin)


def test_other_environments_and_numbers_are_refused(shield: KinematicShield) -> None:
    with pytest.raises(ArgumentError, match="must be an environment of coop_env"):
        KinematicShield(gym.make("CartPole-v1"))
    for late in ("randomized", SimToReal(latency=1)):
        with pytest.raises(ArgumentError, match="latency"):
            KinematicShield(CoopInsertionEnv(sim_to_real=late))
    narrow = CoopInsertionEnv(geometry={**asdict(OPTIMIZED), "joint_max": np.radians(60.0)})
    with pytest.raises(ArgumentError, match="leaves nothing of the joints' range"):
        KinematicShield(narrow, {"joint": 0.42})
    with pytest.raises(ArgumentError, match="twelve moves"):
        ShieldWrapper(gym.make("CoopInsertionJoint-v0"))
    with pytest.raises(ArgumentError, match="state = "):
        shield.certify([0.0] * 5, [0.0] * 6)
    with pytest.raises(ActionError, match="action = "):
        shield.certify([0.0] * 6, [np.nan] * 6)


def test_a_certificate_that_would_leave_moves_out_is_refused(env: CoopInsertionEnv) -> None:
    strict = KinematicShield(env, ShieldMargin(sigma=1.0))  # more than the flat platform has
    with pytest.raises(ArgumentError, match="choose another origin"):
        certify_lattice(strict, env.params, np.array([0.0, 0.0, -0.35, 0.0, 0.0, 0.22]))


def test_a_certificate_counts_what_a_walk_over_its_lattice_does(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A coarse one, of a shield that takes the effector for smaller than the task says it is."""
    monkeypatch.setattr(certificate, "CHUNK", 7)
    task = {"linear_step": 0.09, "angular_step": 0.3, "heave_step": 0.02}
    env, thick = (
        CoopInsertionEnv(task=task),
        CoopInsertionEnv(task={**task, "effector_radius": 0.08}),
    )
    env.reset(seed=12)
    origin, steps = env.configuration, np.array(env.task.steps)
    shield = KinematicShield(env, {"sigma": 0.2, "reach": 0.3, "joint": 0.1})
    shares: list[float] = []
    found = certify_lattice(shield, thick.params, origin, shares.append)
    low, high = axis_bounds(env.params)
    lines = [origin[k] + steps[k] * np.arange(-30, 31) for k in range(6)]
    axes = [line[(line >= low[k]) & (line <= high[k])] for k, line in enumerate(lines)]
    delta, tilts = (np.array(list(product(*part))) for part in (axes[:3], axes[3:]))
    grown, most = shield.margin.tighten(thick.params), thick.params.rrs.heave_max
    near = [below_ceiling((x, y, z - steps[2], 0.0, 0.0, most), grown) for x, y, z in delta]
    flat, over = np.array([[0.0, 0.0, origin[5]]]), delta[~np.array(near)]
    alone = [p for p in over if shield.is_certified([*p, *flat[0]])][:1]
    counts, moves = np.zeros(4, int), MOVES * steps
    for one, other in ((delta[near], tilts), (over, flat), (alone, tilts)):
        for c in (np.concatenate(pair) for pair in product(one, other)):
            if shield.is_certified(c):
                allowed = shield.allowed_moves(c)
                ways = [c + np.outer(np.arange(8) / 7, move) for move in moves[::2][allowed[::2]]]
                harmful = sum(any(map(thick.configuration_status, way)) for way in ways)
                counts += [1, 2 * len(ways), harmful, not allowed.any()]
    assert list(found) == counts.tolist()
    assert min(found) > 0
    assert shares == pytest.approx([min(1.0, done / 60) for done in range(7, 67, 7)])


def test_a_lattice_has_its_bounds_and_its_near_points_are_a_move_from_the_ceiling(
    env: CoopInsertionEnv, shield: KinematicShield
) -> None:
    for bound in axis_bounds(env.params):
        delta, tilts = certificate.lattice(env.params, bound)
        assert np.isclose(delta, bound[:3]).all(axis=1).any()
        assert np.isclose(tilts, bound[3:]).all(axis=1).any()
    heights = np.zeros((400, 3)) + np.linspace(-0.65, -0.25, 400)[:, None] * [0.0, 0.0, 1.0]
    grown, most = shield.margin.tighten(env.params), env.params.rrs.heave_max
    down = env.task.steps[2]
    near = [below_ceiling((x, y, z - down, 0.0, 0.0, most), grown) for x, y, z in heights]
    assert certificate.near_points(shield, env.params, heights).tolist() == near
    assert 0 < sum(near) < 400


ARGUMENTS: dict[str, Any] = {"reward": "progress", "mask_singularities": True}


def test_masks_are_the_wrappers_on_the_way() -> None:
    rng = np.random.default_rng(0)
    batch = ShieldedInsertionVecEnv(3, seed=10, **ARGUMENTS)
    alone = [ShieldWrapper(CoopInsertionEnv(**ARGUMENTS)) for _ in range(3)]
    batch.reset()
    for number, env in enumerate(alone):
        env.reset(seed=10 + number)
    tightened = 0
    for _ in range(60):
        masks = np.array(batch.env_method("action_masks"))
        np.testing.assert_array_equal(masks, [env.action_masks() for env in alone])
        own = np.array([env.env.unwrapped.action_masks() for env in alone])  # type: ignore[attr-defined]
        tightened += int((own & ~masks).any())
        actions = np.array([rng.choice(np.flatnonzero(mask)) for mask in masks])
        _, _, dones, infos = batch.step(actions)
        assert not any(info["collision"] or info["singular"] for info in infos)
        if dones.any():
            break
        for env, action in zip(alone, actions, strict=True):
            assert not env.step(action)[-1]["shielded"]
    assert tightened > 0
    single = ShieldedInsertionEnv(mask_visited=8)
    single.reset(seed=3)
    single.step(4)
    forbidden = single.shield.allowed_moves(single.configuration) & ~single.action_masks()
    assert np.flatnonzero(forbidden).tolist() == [5]  # back to where it came from
    other = ShieldedInsertionEnv({"sigma": 0.2}, **ARGUMENTS)
    with pytest.raises(StateError, match="other arguments"):
        other.set_state(ShieldedInsertionEnv(**ARGUMENTS).get_state())
