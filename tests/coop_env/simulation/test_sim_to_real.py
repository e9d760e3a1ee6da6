"""Sim-to-real knobs: each does what it says, from the seed alone, and off means off."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coop_env import CoopInsertionEnv, SimToReal
from coop_env.geometry import DELTA, OPTIMIZED
from coop_env.kinematics import delta, rrs
from coop_env.physics.model import Machine
from coop_env.physics.task import start_configurations
from coop_env.simulation.machine import MACHINE, gaussian, uniform
from coop_env.simulation.sim_to_real import RANDOMIZED, draw_machine
from coop_env.simulation.state import state_dtype
from tests.coop_env.simulation.bodies import gap

LENGTHS = (
    ("base_radius", "proximal_length", "platform_radius", "distal_length"),
    ("base_radius", "effector_radius", "proximal_length", "distal_length"),
)


def test_the_controller_sees_its_model_and_the_info_is_the_truth() -> None:
    env = CoopInsertionEnv(sim_to_real=SimToReal(base_position_error=0.01), normalize=False)
    for seed in range(10):
        obs, info = env.reset(seed=seed)
        twin = CoopInsertionEnv(normalize=False)
        start = {"configuration": env.configuration, "target": int(env.state["target"])}
        np.testing.assert_allclose(obs, twin.reset(options=start)[0], atol=1e-6)
        shift = env.state["machine"]["base"][:3]
        believed = obs[6:9]
        assert info["distance"] == pytest.approx(np.linalg.norm(believed + shift), abs=1e-6)


@pytest.mark.parametrize("normalize", [True, False])
def test_noise_has_the_standard_deviation_asked_for(normalize: bool) -> None:
    """A share of the ranges that the normalized observation has, in metres and radians too."""
    start = {"configuration": (0.02, 0.03, -0.33, 0.1, 0.1, 0.22), "target": 4}
    noisy, clean = (
        CoopInsertionEnv(sim_to_real=knobs, normalize=normalize, max_moves=10_000)
        for knobs in (SimToReal(observation_noise=0.01), SimToReal())
    )
    obs, _ = noisy.reset(seed=0, options=start)
    assert noisy.observation_space.contains(obs)
    expected, _ = clean.reset(options=start)
    space = clean.observation_space
    low, high = space.low.copy(), space.high.copy()
    if not normalize:
        low[6:9], high[6:9] = -clean.task.error_bound, clean.task.error_bound
    spans = high - low
    deviations = [noisy.step(k % 2)[0] - clean.step(k % 2)[0] for k in range(2000)] / spans
    share = (expected - low) / (high - low)
    inside = (share > 0.05) & (share < 0.95)
    assert inside.sum() >= 8
    np.testing.assert_allclose(np.std(deviations, axis=0)[inside], 0.01, rtol=0.1)
    np.testing.assert_allclose(np.mean(deviations, axis=0)[inside], 0.0, atol=0.001)


def test_a_configuration_in_a_hole_may_be_named_with_knobs_too() -> None:
    """The nominal machine may begin there; drawn starts do not."""
    env = CoopInsertionEnv()
    start = {"configuration": start_configurations(Machine(), 0.002)[4], "target": 4}
    assert env.reset(options=start)[1]["distance"] < env.task.tolerance
    assert env.state["inside"].any()
    noisy = CoopInsertionEnv(sim_to_real=SimToReal(observation_noise=0.01))
    noisy.reset(options=start)
    assert noisy.state["inside"].any()


def test_equal_knobs_share_their_snapshots() -> None:
    knobs: Any = {"latency": np.int64(1), "randomize": np.True_, "backlash": 0.01}
    env = CoopInsertionEnv(sim_to_real=SimToReal(**knobs))
    other = CoopInsertionEnv(sim_to_real=SimToReal(latency=1, randomize=True, backlash=0.01))
    env.reset(seed=0)
    other.set_state(env.get_state())
    assert env.state.tobytes() == other.state.tobytes()


def test_latency_executes_the_previous_action() -> None:
    late = CoopInsertionEnv(sim_to_real=SimToReal(latency=1))
    late.reset(seed=0)
    start = late.configuration
    info = late.step(0)[4]
    np.testing.assert_array_equal(late.configuration, start)
    assert not info["violation"]
    late.step(2)
    assert late.configuration[0] == pytest.approx(start[0] + 0.02)
    assert late.configuration[1] == start[1]


@pytest.mark.parametrize(("play", "count"), [(0.01, 0.0), (0.0, 0.005), (0.01, 0.005)])
def test_a_joint_stays_where_it_is_within_half_the_play_of_the_nearest_count(
    play: float, count: float
) -> None:
    env = CoopInsertionEnv(sim_to_real=SimToReal(backlash=play, joint_resolution=count))
    ideal, rng = CoopInsertionEnv(), np.random.default_rng(0)
    env.reset(seed=0)
    joints: np.ndarray | None = None
    gaps: list[np.ndarray] = []
    energy = 0.0
    for _ in range(100):
        ideal.reset(options={"configuration": env.configuration, "target": 0})
        there, wanted = (np.concatenate([e.state["theta"], e.state["q"]]) for e in (env, ideal))
        nearest = count * np.floor(wanted / count + 0.5) if count else wanted
        before = wanted if joints is None else joints
        joints = np.clip(before, nearest - play / 2, nearest + play / 2)
        energy += np.abs(joints - before).sum() if gaps else 0.0  # the start costs none
        assert there == pytest.approx(joints, abs=1e-12)
        assert env.state["energy"] == pytest.approx(energy, abs=1e-12)
        gaps.append(there - nearest)
        if env.step(int(rng.choice(np.flatnonzero(env.action_masks()))))[4]["violation"]:
            break
    assert len(gaps) > 10
    if play:
        assert np.min(gaps) < -play / 3 < play / 3 < np.max(gaps)


def test_every_episode_has_a_machine_of_its_own_which_its_seed_gives() -> None:
    env = CoopInsertionEnv(sim_to_real="randomized")
    assert env.sim_to_real is RANDOMIZED
    machines = []
    for seed in (*range(20), 0):
        env.reset(seed=seed)
        machines.append(env.state["machine"])
    assert machines[0].tobytes() == machines[20].tobytes()
    assert len({machine["lengths"].tobytes() for machine in machines}) == 20


def test_a_machine_that_cannot_stand_at_the_start_is_drawn_anew() -> None:
    """A forearm is by a link, which some displacements bring too near."""
    env, nominal = CoopInsertionEnv(sim_to_real={"base_position_error": 0.01}), CoopInsertionEnv()
    start = {"configuration": (-0.07349, 0.13168, -0.552, 0.18639, 0.31019, 0.22992)}
    nominal.reset(options=start)
    for seed in range(20):
        env.reset(seed=seed, options=start)
        shift = env.state["mouths"] - nominal.state["mouths"]
        assert shift == pytest.approx(np.tile(env.state["machine"]["base"][:3], (6, 1)), abs=1e-9)


def test_a_peg_goes_in_as_often_as_the_knob_says() -> None:
    env = CoopInsertionEnv(sim_to_real=SimToReal(insertion_probability=0.3))
    start = {"configuration": start_configurations(Machine(), 0.022)[4], "target": 4}
    inserted = []
    for seed in range(400):
        env.reset(seed=seed, options=start)
        inserted.append(env.step(5)[4]["inserted"])
    assert np.mean(inserted) == pytest.approx(0.3, abs=0.07)


def test_machines_are_drawn_within_the_bounds_and_near_them() -> None:
    """No two errors hang together, and a randomized machine errs half as far on average."""
    p, rng = CoopInsertionEnv().params, np.random.default_rng(0)

    def draw(knobs: SimToReal) -> dict[str, np.ndarray]:
        drawn = np.zeros(400, MACHINE)
        for machine in drawn:
            draw_machine(machine, knobs, p, rng)
        errors = {
            "link_length_error": drawn["lengths"] / [*p.rrs[:4], *p.delta[:4]] - 1.0,
            "base_position_error": drawn["base"][:, :3],
            "base_tilt_error": drawn["base"][:, 3:],
            "chamfer_error": drawn["chamfer"] - p.task.chamfer,
            "backlash": drawn["backlash"],
            "joint_resolution": drawn["resolution"],
            "observation_noise": drawn["noise"],
        }
        assert drawn["tolerance"] - p.task.tolerance == pytest.approx(errors["chamfer_error"])
        errors |= {"probability": drawn["insertion_probability"], "latency": drawn["latency"]}
        return {name: error.reshape(400, -1) for name, error in errors.items()}

    fixed, scaled = draw(replace(RANDOMIZED, randomize=False)), draw(RANDOMIZED)
    for name in list(fixed)[:4]:  # of either sign
        bound = getattr(RANDOMIZED, name)
        for drawn in (fixed[name], scaled[name]):
            assert np.abs(drawn).max() <= bound * (1.0 + 1e-9), name
            assert (drawn.min(axis=0) < -0.7 * bound).all(), name
            assert (drawn.max(axis=0) > 0.7 * bound).all(), name
        narrower = np.abs(scaled[name]).mean() / np.abs(fixed[name]).mean()
        assert narrower == pytest.approx(0.5, abs=0.1), name
    for name in list(fixed)[4:7]:
        bound = getattr(RANDOMIZED, name)
        assert (fixed[name] == bound).all(), name
        share = scaled[name] / bound
        assert 0.0 <= share.min() < 0.1 < 0.9 < share.max() <= 1.0, name
    least = RANDOMIZED.insertion_probability
    assert fixed["probability"] == pytest.approx(least)
    assert least <= scaled["probability"].min() < least + 0.01
    assert 0.99 < scaled["probability"].max() <= 1.0
    assert (fixed["latency"] == 1).all()
    assert scaled["latency"].mean() == pytest.approx(0.5, abs=0.1)
    together = np.corrcoef(np.hstack(list(scaled.values())), rowvar=False)
    assert np.abs(together - np.eye(len(together))).max() < 0.25


def test_the_rows_generator_is_uniform_and_normal() -> None:
    machine = np.zeros(1, state_dtype(6))[0]["machine"]
    machine["key"] = 12345
    draws = np.array([uniform(machine) for _ in range(20_000)])
    assert 0.0 <= draws.min() <= draws.max() < 1.0
    counts, _ = np.histogram(draws, bins=20, range=(0.0, 1.0))
    assert np.abs(counts - 1000).max() < 130
    assert abs(np.corrcoef(draws[:-1], draws[1:])[0, 1]) < 0.03
    normal = np.array([gaussian(machine) for _ in range(20_000)])
    assert abs(normal.mean()) < 0.03
    assert normal.std() == pytest.approx(1.0, abs=0.03)


def test_an_erring_machine_stands_where_its_links_lead_and_touches_nothing() -> None:
    """With its own lengths, base, chamfer, play; against closed forms, and all pairs of bodies."""
    bounds: dict[str, Any] = {
        "link_length_error": 0.01, "base_position_error": 0.01, "base_tilt_error": 0.05,
        "chamfer_error": 0.008, "backlash": 0.01, "joint_resolution": 0.005,
    }  # fmt: skip
    env = CoopInsertionEnv(sim_to_real=SimToReal(**bounds))
    rng, weights = np.random.default_rng(0), np.ones(12) / 18
    weights[[5, 10]] = 4 / 18  # down, and the platform up
    gaps, refused = [], 0
    above = (0.0, 0.0, -0.41, 0.0, 0.0, 0.22)
    beside = (-0.0735, 0.1317, -0.50, 0.1864, 0.3102, 0.2299)  # a forearm is by a link
    for seed in range(60):
        env.reset(seed=seed, options={"configuration": beside if seed % 2 else above})
        over = False
        for _ in range(40):
            *_, over, _, info = env.step(int(rng.choice(12, p=weights)))
            refused += info["collision"]
            if over:
                break
            if info["violation"]:
                continue
            s = env.state
            lengths, base, at = (s["machine"][name] for name in ("lengths", "base", "actual"))
            geometry = replace(OPTIMIZED, **dict(zip(LENGTHS[0], lengths[:4], strict=True)))
            robot = replace(DELTA, **dict(zip(LENGTHS[1], lengths[4:], strict=True)))
            assert rrs.inverse(at[3:], geometry).q == pytest.approx(s["q"], abs=1e-7)
            assert delta.inverse(at[:3], robot).theta == pytest.approx(s["theta"], abs=1e-7)
            # a rate of heave counts per nominal length
            units = [1.0, 1.0, OPTIMIZED.characteristic_length / geometry.characteristic_length]
            values = np.linalg.svd(rrs.jacobian(at[3:], geometry) * units, compute_uv=False)
            assert s["sigma"] == pytest.approx(values[2], abs=1e-9)
            turn, pose = Rotation.from_euler("XY", base[3:]), rrs.platform_pose(at[3:], geometry)
            normals = turn.apply(np.array(env.task.hole_normals) @ pose.rotation.T)
            centre = turn.apply(pose.position) + base[:3]
            assert s["normals"] == pytest.approx(normals, abs=1e-9)
            assert s["mouths"] == pytest.approx(centre + env.task.dome_radius * normals, abs=1e-9)
            limbs = turn.apply(rrs.limb_points(at[3:], geometry).reshape(9, 3)) + base[:3]
            up, chamfer = np.array([0.0, 0.0, DELTA.base_height]), float(s["machine"]["chamfer"])
            near = np.linalg.norm(s["mouths"] - s["tip"], axis=1) < s["machine"]["tolerance"]
            upright = normals[:, 2] > np.cos(env.task.angle_tolerance)
            assert (s["inside"] == 1).tolist() == (near & upright).tolist()
            arms, limbs = delta.limb_points(at[:3], robot) + up, limbs.reshape(3, 3, 3)
            gaps.append(gap(env, at[:3] + up, arms, centre, limbs, s["mouths"], chamfer))
    assert 0.0 <= min(gaps) < 1e-3
    assert refused > 100
