"""The twin behind the protocol of a machine, and policies that drive a machine through it."""

import threading
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

pytest.importorskip("ruckig", reason="ruckig is not installed (extra trajectory)")

from coop_env import InsertionTask
from coop_env.errors import ArgumentError
from coop_env.kinematics.delta import forward
from coop_env.physics.driver import Driver, DriverError, Replayed, TwinDriver, replay
from coop_env.physics.model import Machine
from coop_env.trajectory import Trajectory, make_trajectory

RING = tuple((0.5, float(k)) for k in range(5))
MACHINE = Machine(task=InsertionTask(holes=((0.0, 0.0), *RING)))  # the first is upright at home
DOWN = 5
LAG = np.array([0.004, 0.004, 0.004, 0.0, 0.0, 0.0])
PATIENCE = 120.0
"""s: an answer is never late, however slow and busy the processor."""


def joints_at(configuration: np.ndarray) -> np.ndarray:
    return make_trajectory([configuration] * 2).positions[0]


class Obedient:
    """A machine that is at once where it was commanded to, but for a lag (6,), rad."""

    def __init__(self, lag: Any = 0.0) -> None:
        self.at = joints_at(MACHINE.home())
        self.lag = lag
        self.felt: Any = np.zeros(3)
        self.commands: list[Trajectory] = []

    def command(self, trajectory: Trajectory) -> None:
        self.commands.append(trajectory)
        self.at = trajectory.positions[-1] + self.lag

    def joints(self) -> np.ndarray:
        return self.at

    def force(self) -> Any:
        return self.felt


def drive(driver: Driver, machine: Machine = MACHINE, **arguments: Any) -> Replayed:
    """Down onto the first hole, unless the arguments say otherwise."""
    action = arguments.pop("action", DOWN)
    arguments = {"target": 0, "holes": 1, "patience": PATIENCE, **arguments}
    return replay(lambda observation, masks: action, driver, machine, **arguments)


@pytest.mark.parametrize("blend", [False, True])
def test_the_twin_follows_within_the_stated_bound(blend: bool) -> None:
    """Both robots, far above the dome; the links of each are moved at the limits."""
    home = Machine().home()
    home[[2, 5]] += 0.05, 0.01  # a way from a limit to another may leave it in between
    turns = np.array([0.02, -0.02, 0.02, 0.03, -0.03, 0.02])
    way = [home, *(home + turns * np.tri(6)[k] for k in range(6)), home]
    planned = make_trajectory(way, blend=blend)
    assert planned.blocked() == []
    driver = TwinDriver(configuration=home)
    driver.command(planned)
    assert len(driver.errors) == len(planned.times)
    assert 1e-4 < np.abs(driver.errors).max() < 0.02  # rad, as docs/trajectory.md says
    assert np.abs(driver.joints() - planned.positions[-1]).max() < 1e-3
    assert 0.05 < np.abs(driver.torques).max() < 0.5 * Machine().servos.torque_limit
    assert np.linalg.norm(driver.force()) < 1.0  # the peg's own inertia: it touches nothing


def test_a_policy_fills_a_hole_of_the_twin() -> None:
    driver = TwinDriver(MACHINE)
    result = drive(driver)
    assert (result.stopped, result.filled) == ("filled", [0])
    distance, angle = driver.miss(0)
    assert distance < MACHINE.task.tolerance
    assert angle < MACHINE.task.angle_tolerance
    drop = MACHINE.home()[2] + MACHINE.delta.base_height - MACHINE.delta.peg_length
    drop -= MACHINE.rrs.home_heave + MACHINE.task.dome_radius
    assert result.moves == np.ceil((drop - MACHINE.task.tolerance) / 0.02)
    assert result.error < 1e-3


def test_the_policy_sees_what_the_machine_reports() -> None:
    """A machine that lags: the next move begins, and is seen, where it stands."""
    seen, driver = [], Obedient(LAG)

    def policy(observation: Any, masks: Any) -> int:
        seen.append(observation)
        return DOWN

    arguments: dict[str, Any] = {"target": 0, "holes": 1, "normalize": False}
    result = replay(policy, driver, MACHINE, max_moves=2, patience=PATIENCE, **arguments)
    assert result.moves == 2
    assert result.error == pytest.approx(0.004)
    assert seen[0][2] - seen[1][2] > 0.02 + 0.0005  # deeper than the move
    first, second = driver.commands
    assert second.positions[0] == pytest.approx(first.positions[-1] + LAG, abs=1e-9)


def test_it_stops_at_limits() -> None:
    driver = Obedient()
    driver.felt = np.array([0.0, 0.0, 50.0])
    result = drive(driver)
    assert (result.stopped, result.moves) == ("a force of 50 N", 1)
    driver = Obedient(4.0 * LAG)
    assert drive(driver, error_limit=0.01).stopped == "a joint is 0.016 rad off its command"
    assert len(driver.commands) == 1
    assert drive(Obedient(), max_moves=1).stopped == "no moves are left"


def test_a_hole_is_filled_where_the_machine_is_and_not_where_it_was_sent() -> None:
    """A Delta that ends most of a move too high."""
    driver = Obedient(-9.0 * LAG)
    result = drive(driver)
    assert (result.stopped, result.filled) == ("filled", [0])
    m = MACHINE
    tip = forward(driver.at[:3], m.delta).position[2] + m.delta.base_height - m.delta.peg_length
    assert abs(tip - m.rrs.home_heave - m.task.dome_radius) < m.task.tolerance
    one_hole = replace(MACHINE, task=replace(MACHINE.task, stage_0_holes=1))
    result = drive(Obedient(), one_hole, holes=None, stage=0)  # all holes that are active
    assert (result.stopped, result.filled) == ("filled", [0])


def test_moves_that_are_not_free_are_not_commanded() -> None:
    driver = Obedient()
    wide = replace(MACHINE, task=replace(MACHINE.task, linear_step=0.2))
    result = drive(driver, wide, action=0)
    assert (result.stopped, driver.commands) == ("the move is not allowed", [])
    # beside the dome, low: the other side can be reached, the way there leads through it
    beside = MACHINE.home()
    beside[[0, 2]] = -0.14, MACHINE.rrs.home_heave + 0.09
    beside[2] += MACHINE.delta.peg_length - MACHINE.delta.base_height
    driver.at = joints_at(beside)
    result = drive(driver, wide, action=0)
    assert (result.stopped, driver.commands) == ("on the way there is a collision", [])


def test_a_machine_that_stops_answering() -> None:
    """Its force comes only when the test is over; all else answers within the patience."""
    driver, over = Obedient(), threading.Event()
    driver.force = over.wait  # type: ignore[method-assign]
    with pytest.raises(DriverError, match=r"wait within 1 s; its last command holds"):
        drive(driver, patience=1.0)
    driver, first = Obedient(), driver
    driver.force = partial(over.wait, None)  # type: ignore[method-assign]
    with pytest.raises(DriverError, match="a call within 1"):
        drive(driver, patience=1.0)
    over.set()
    assert len(first.commands) == 1
    assert first.at == pytest.approx(first.commands[0].positions[-1])


def test_a_machine_that_answers_nonsense() -> None:
    driver = Obedient()
    driver.felt = [1.0, float("nan"), 0.0]
    with pytest.raises(DriverError, match="must be 3 finite numbers"):
        drive(driver)
    driver.at = driver.at[:5]
    with pytest.raises(DriverError, match="must be 6 finite numbers"):
        drive(driver)
    driver.at = "here"  # type: ignore[assignment]
    with pytest.raises(DriverError, match="answered 'here': must be 6 numbers"):
        drive(driver)
    driver = Obedient()  # an error of its own comes as it is
    driver.command = lambda trajectory: 1 / 0  # type: ignore[method-assign,assignment]
    with pytest.raises(ZeroDivisionError):
        drive(driver)


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("mask_visited", 3), ("observation", "markov"), ("target", 6), ("target", -1), ("holes", 0),
        ("holes", 7), ("force_limit", -1), ("error_limit", float("nan")), ("patience", "a"),
        ("max_moves", 0), ("geometry", "initial"),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_refused_before_a_command(name: str, wrong: Any) -> None:
    driver = Obedient()
    with pytest.raises(ArgumentError, match=name):
        drive(driver, **{name: wrong})
    assert driver.commands == []


def test_where_a_machine_cannot_begin_it_is_not_commanded() -> None:
    """In the dome; an encoder that is a turn off, or angles of another branch."""
    low = joints_at(MACHINE.home() - [0.0, 0.0, 0.12, 0.0, 0.0, 0.0])
    turned = joints_at(MACHINE.home()) + 2 * np.pi * np.eye(6)[0]
    another = np.array([3, -3, 3, 0.3, 0.3, 0.3])
    stands = "the machine stands where it must not"
    for joints, reason in ((low, stands), (turned, "begins"), (another, "begins")):
        driver = Obedient()
        driver.at = joints
        assert reason in drive(driver).stopped
        assert driver.commands == []
