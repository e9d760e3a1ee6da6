"""Machines that err: what each knob changes and what it leaves alone, seeds, bounds, bad values."""

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from coop_env import CoopInsertionEnv, SimToReal
from coop_env.errors import ArgumentError
from coop_env.geometry import GeometryError
from coop_env.kinematics import delta, rrs
from coop_env.physics.batch import PRIVILEGED
from coop_env.physics.env import CoopInsertionContactEnv, CoopInsertionPhysicsEnv
from coop_env.physics.moves import CoopInsertionPhysicsDiscreteEnv
from coop_env.physics.validation import loop_residual
from coop_env.simulation.sim_to_real import (
    CONTACT_KNOBS,
    FORGE,
    KINEMATIC_KNOBS,
    MASSES,
    UNDISTURBED,
    draw_disturbance,
)
from tests.coop_env.physics.episodes import ASIDE, PUSH, REST, RIM


def make(seed: int = 3, **knobs: Any) -> CoopInsertionContactEnv:
    env = CoopInsertionContactEnv(sim_to_real=knobs or None)
    env.reset(seed=seed)
    return env


def test_every_knob_is_of_one_kind_or_of_both() -> None:
    both = {"link_length_error", "backlash", "joint_resolution", "latency", "randomize"}
    assert {f.name for f in fields(SimToReal)} == both | CONTACT_KNOBS | KINEMATIC_KNOBS
    assert FORGE.turned == (both - {"randomize"}) | CONTACT_KNOBS


def test_knobs_at_zero_are_no_knobs() -> None:
    """Bit for bit, and a disturbed episode leaves nothing behind where its knobs end."""
    plain, zero = make(), make(randomize=True)
    for _ in range(10):
        mine, theirs = plain.step(ASIDE), zero.step(ASIDE)
        assert (mine[0].tobytes(), mine[1]) == (theirs[0].tobytes(), theirs[1])
    noisy = make(force_noise=0.5)  # the draws are the same, so is where things are
    noisy.step(ASIDE)
    plain.reset(seed=3)
    plain.step(ASIDE)
    assert noisy.batch.twin.states.tobytes() == plain.batch.twin.states.tobytes()


@pytest.mark.parametrize(
    "env_class", [CoopInsertionContactEnv, CoopInsertionPhysicsEnv, CoopInsertionPhysicsDiscreteEnv]
)
def test_a_seed_gives_the_same_machine(env_class: Any) -> None:
    env = env_class(sim_to_real="randomized")
    seen = [env.reset(seed=seed)[1]["privileged"] for seed in (1, 1, 2, None)]
    assert np.array_equal(seen[0], seen[1])
    for one, other in ((0, 2), (2, 3)):  # each episode another
        assert not np.array_equal(seen[one][17:], seen[other][17:])


def test_machines_are_drawn_within_the_bounds() -> None:
    """And go near them: to a fifth of their range."""
    rng = np.random.default_rng(0)
    drawn = [draw_disturbance(FORGE, rng) for _ in range(400)]
    bounds = {
        "lengths": (0.998, 1.002), "gains": (1.0 / 1.41, 1.41), "masses": (0.83, 1.17),
        "friction": (1.0 / 2.24, 2.24), "dead_zone": (0.0, 0.33), "backlash": (0.0, FORGE.backlash),
        "resolution": (0.0, FORGE.joint_resolution), "force_noise": (0.0, 1.0),
    }  # fmt: skip
    for name, (low, high) in bounds.items():
        values, near = np.array([getattr(d, name) for d in drawn]), 0.2 * (high - low)
        assert low <= values.min() < low + near < high - near < values.max() <= high, name
    gains = np.array([d.gains for d in drawn])
    assert np.mean(gains > 1.0) == pytest.approx(0.5, abs=0.05)
    assert np.abs(np.corrcoef(np.sign(np.log(gains)).T) - np.eye(6)).max() < 0.25  # each its own
    whole = [draw_disturbance(replace(FORGE, randomize=False), rng) for _ in range(400)]
    errors = [
        np.abs([[*np.log(d.gains), *(d.masses - 1.0)] for d in some]) for some in (drawn, whole)
    ]
    narrower = errors[0].mean(axis=0) / errors[1].mean(axis=0)  # by a factor of each knob's own
    assert narrower == pytest.approx(np.full(13, 0.5), abs=0.12)
    sizes = errors[0][:, :6].mean(axis=1), errors[0][:, 6:].mean(axis=1)
    assert np.abs(np.corrcoef(sizes) - np.eye(2)).max() < 0.2
    assert np.mean([d.latency for d in drawn]) == pytest.approx(0.5, abs=0.08)
    fixed = draw_disturbance(replace(FORGE, randomize=False), rng)
    assert (fixed.dead_zone, fixed.latency, fixed.force_noise) == (0.33, 1.0, 1.0)
    nothing = draw_disturbance(SimToReal(), rng)
    assert np.array_equal(np.hstack(nothing), np.hstack(UNDISTURBED))


def test_bodies_weigh_what_was_drawn_and_are_carried_as_if_nominal() -> None:
    plain, heavy = make().batch, make(mass_error=0.2).batch
    nominal, model = plain.twin.models[0], heavy.twin.models[0]
    assert heavy.command.tolist() == plain.command.tolist()  # the same draws otherwise
    factors = dict(zip(MASSES, heavy.disturbances[0].masses, strict=True))
    assert np.ptp(list(factors.values())) > 0.1
    for i in range(1, model.nbody):
        name = next((n for n in MASSES if model.body(i).name.startswith(n)), "")
        expected = factors.get(name, 1.0) * nominal.body_mass[i]
        assert model.body_mass[i] == pytest.approx(expected)
        if name:
            assert model.body_gravcomp[i] * expected == pytest.approx(nominal.body_mass[i])


def test_links_of_other_lengths_stand_where_their_kinematics_say() -> None:
    env = make(link_length_error=0.01)
    twin, command = env.batch.twin, env.batch.command[0]
    real, joints, readings = twin.machines[0], twin.servo_targets(command), twin.readings()
    assert readings.joints[0] == pytest.approx(joints, abs=1e-9)
    assert loop_residual(twin, 0) < 1e-9
    position = delta.forward(joints[:3], real.delta).position
    up = np.array([0.0, 0.0, real.delta.base_height - real.delta.peg_length])
    assert readings.tip[0] == pytest.approx(position + up, abs=1e-9)
    assert np.linalg.norm(position - command[:3]) > 1e-4
    env.step(REST)
    pose = rrs.forward(readings.joints[0, 3:], command[3:], real.rrs).pose
    centre = rrs.platform_pose(pose, real.rrs).position
    still = make(link_length_error=0.01)
    still.reset(seed=3, options={"error": [0.0] * 4})
    assert still.batch.twin.readings().platform[0] == pytest.approx(centre, abs=1e-9)


def test_a_late_command_arrives_a_step_later() -> None:
    late, prompt = make(latency=1), make()
    start = late.batch.twin.readings().joints[0]
    late.step(ASIDE)
    assert late.batch.twin.readings().joints[0] == pytest.approx(start, abs=2e-5)
    late.step(REST)
    prompt.step(ASIDE)
    moved = prompt.batch.twin.readings().joints[0]
    assert np.abs(moved - start).max() > 1e-3
    assert late.batch.twin.readings().joints[0] == pytest.approx(moved, abs=5e-5)


def rest(env: CoopInsertionContactEnv, *actions: np.ndarray) -> np.ndarray:
    """Joint angles after actions and a second's rest, minus what is commanded then."""
    for action in (*actions, *[REST] * 20):
        env.step(action)
    twin = env.batch.twin
    off: np.ndarray = twin.readings().joints[0] - twin.servo_targets(env.batch.command[0])
    return off


def test_play_is_left_where_a_joint_turns_round() -> None:
    play, way = 0.0005, [*[ASIDE] * 3, -ASIDE]
    assert np.abs(rest(make(), *way)).max() < 2e-5
    off = rest(make(backlash=play), *way)
    assert np.abs(off) == pytest.approx(np.full(6, play / 2.0), abs=2e-5)


def test_commands_go_to_the_nearest_count() -> None:
    env = make(joint_resolution=0.004)
    off = rest(env, *[ASIDE] * 3)
    counts = (off + env.batch.twin.servo_targets(env.batch.command[0])) / 0.004
    assert counts == pytest.approx(np.round(counts), abs=0.02)


def test_dry_friction_takes_up_small_torques() -> None:
    """Half a millimetre asks for 0.1 N m of the Delta's soft servos."""
    step = np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert np.abs(rest(make(), step)[:3]).max() < 1e-5
    env = make(servo_dead_zone=0.33)
    start = env.batch.twin.readings().joints[0, :3]
    rest(env, step)
    assert env.batch.twin.readings().joints[0, :3] == pytest.approx(start, abs=1e-5)


def test_torques_are_those_of_the_servos_own_stiffness() -> None:
    """Pressed on the rim, at rest: what each servo holds against is its gain times its error."""
    env = make(servo_gain_error=1.0)
    env.reset(seed=3, options=RIM)
    off = rest(env, *[0.5 * PUSH] * 25)
    gains = env.batch.disturbances[0].gains
    assert np.ptp(gains) > 0.3
    torques = env.batch.twin.inspect(0)[1].actuator_force
    assert np.abs(torques[:3]).min() > 0.1
    stiffness = np.repeat([50.0, 1000.0], 3) * gains
    assert torques == pytest.approx(-stiffness * off, rel=0.02, abs=2e-3)


def test_forces_are_as_noisy_as_asked_for() -> None:
    env = make(force_noise=1.0)
    felt = [10.0 * env.step(REST)[0][11:17] for _ in range(79)]
    spread = np.std(felt, axis=0)
    assert spread[:3] == pytest.approx(np.ones(3), abs=0.3)
    assert (spread[3:] / 10.0 * 0.05 < 0.001).all()
    both = CoopInsertionContactEnv({"force_noise": 3.0}, sim_to_real={"force_noise": 4.0})
    both.reset(seed=0)
    assert both.batch._noise[0, :3].tolist() == [5.0, 5.0, 5.0]  # independent: the squares add


def test_friction_that_an_option_sets_has_no_error() -> None:
    _, info = make(friction_error=1.0).reset(options={"friction": 0.25})
    assert info["friction"] == 0.25


def test_a_critic_sees_what_is_so() -> None:
    env = CoopInsertionContactEnv(sim_to_real=FORGE, privileged=True)
    seen, info = env.reset(seed=2)
    assert env.observation_space.contains(seen)
    assert np.array_equal(seen["privileged"], info["privileged"])
    for _ in range(12):
        seen, *_, info = env.step([0.1, 0.0, -1.0, 0.0, 0.0, 0.0])
    ends = np.cumsum([size for size, _ in PRIVILEGED.values()])[:-1]
    report = dict(zip(PRIVILEGED, np.split(seen["privileged"].astype(float), ends), strict=True))
    tip, normal = 0.01 * report["tip - mouth"], report["normal"]
    assert -tip @ normal == pytest.approx(info["depth"], abs=1e-6)
    lateral = np.linalg.norm(tip - (tip @ normal) * normal)
    assert lateral == pytest.approx(info["lateral_error"], abs=1e-6)
    assert 10.0 * report["force"] == pytest.approx(info["force"], abs=1e-5)
    assert report["friction"] == pytest.approx(info["friction"])
    assert 0.05 * report["base"] == pytest.approx(info["error"], abs=1e-8)
    errors = env.batch.disturbances[0]
    assert 1.0 + 0.01 * report["lengths"] == pytest.approx(errors.lengths)
    assert 1.0 + report["gains"] == pytest.approx(errors.gains)
    assert report["force noise"] == pytest.approx(errors.force_noise)
    assert not np.any(make().batch.privileged(slice(0, 1))[0, 17:])  # a nominal machine has none


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"servo_gain_error": -0.1}, "SimToReal.servo_gain_error = -0.1: must be at least 0"),
        ({"mass_error": 1.0}, "SimToReal.mass_error = 1.0: must be at least 0 and at most 0.9"),
        ("forge", "sim_to_real = 'forge'"),
        ({"observation_noise": 0.1}, "SimToReal.observation_noise: the machine has contact here"),
    ],
)
def test_one_clear_error_for_what_cannot_be(wrong: Any, message: str) -> None:
    for env_class in (CoopInsertionContactEnv, CoopInsertionPhysicsDiscreteEnv):
        with pytest.raises(ArgumentError, match=message):
            env_class(sim_to_real=wrong)


@pytest.mark.parametrize("knob", sorted(CONTACT_KNOBS))
def test_the_kinematic_task_has_no_knobs_of_contact(knob: str) -> None:
    with pytest.raises(ArgumentError, match=f"{knob}: only the environments with contact"):
        CoopInsertionEnv(sim_to_real={knob: 0.1})


def test_links_that_never_close_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """A Delta that hardly reaches down to the dome; it may draw one machine only."""
    monkeypatch.setattr("coop_env.physics.batch.TRIES", 1)
    knobs = {"link_length_error": 0.05}
    env = CoopInsertionContactEnv(delta={"base_height": 1.04}, sim_to_real=knobs)
    with pytest.raises(GeometryError, match=r"link_length_error = 0\.05: none of 1 machines"):
        _ = [env.reset(seed=seed) for seed in range(40)]


def test_rewards_are_scaled_and_successes_named() -> None:
    plain, scaled = make(), CoopInsertionContactEnv(reward_scale=0.1)
    scaled.reset(seed=3)
    for _ in range(3):
        one, tenth = plain.step(ASIDE), scaled.step(ASIDE)
        assert tenth[1] == pytest.approx(0.1 * one[1])
        assert tenth[1] == pytest.approx(sum(tenth[-1]["reward_terms"].values()))
    for scale in (0.0, -1.0, "big"):
        with pytest.raises(ArgumentError, match="reward_scale"):
            CoopInsertionContactEnv(reward_scale=scale)  # type: ignore[arg-type]


@pytest.mark.parametrize("env_class", [CoopInsertionContactEnv, CoopInsertionPhysicsEnv])
def test_whatever_the_links_a_machine_stands_free_and_has_not_snapped(env_class: Any) -> None:
    env = env_class(sim_to_real={"link_length_error": 0.05})
    off = []
    for seed in range(12):
        env.reset(seed=seed)
        off.append(env.batch.twin.platform_error(env.batch.twin.readings(), env.batch.command)[0])
        assert env.step(np.zeros(6))[-1]["failure"] == ""
    assert max(off) > env.task.snap_angle
