"""A machine as three methods, the twin behind them, and a policy that drives it."""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from coop_env.env import CoopInsertionEnv
from coop_env.errors import ArgumentError, ResetOptionError, check_integer, check_number
from coop_env.physics.joints import Floats
from coop_env.physics.model import Machine
from coop_env.physics.twin import Twin, closed_at
from coop_env.simulation.task import N_AXES
from coop_env.trajectory import Trajectory, make_trajectory

SETTLING: Final = 0.1
"""s for which the twin holds a trajectory's end before its command is over."""
MEMORIES: Final = ("mask_visited", "mask_refused", "sim_to_real")
MachinePolicy = Callable[[Any, Any], Any]
"""From an observation and its action masks to an action."""


class DriverError(RuntimeError):
    """The machine does not answer, or its answer is invalid; its last command holds."""


class Driver(Protocol):
    """Interface of a machine: a real one is a class with these three methods."""

    def command(self, trajectory: Trajectory) -> None:
        """Carry the trajectory out, from where the machine stands; returns at its end."""

    def joints(self) -> Floats:
        """Measured angles (6,) of the joints of ``coop_env.trajectory.JOINTS``, rad."""

    def force(self) -> Floats:
        """The largest force on the peg since the last command, (3,), world frame, N."""


class TwinDriver:
    """The simulated machine as a :class:`Driver`, at first at home or at a configuration (6,).

    Raises:
        ArgumentError: the configuration is out of reach.
    """

    def __init__(
        self, machine: Machine | None = None, configuration: ArrayLike | None = None
    ) -> None:
        self.twin = Twin(machine)
        self._kp, self._kv = self.twin.machine.servos.gains
        self._weight = self._force = np.zeros(3)
        self.place(self.twin.machine.home() if configuration is None else configuration)
        self.errors: Floats = np.zeros((0, N_AXES))
        """Measured minus commanded angles (samples, 6) of the last trajectory, rad."""
        self.torques: Floats = np.zeros((0, N_AXES))
        """Torques of the six servos (samples, 6) in the last trajectory, by their law, N m."""

    def place(self, configuration: ArrayLike) -> None:
        """Set the machine down at rest at a configuration (6,).

        Raises:
            ArgumentError: the configuration is out of reach.
        """
        self._weight = self.twin.place(0, configuration).wrench[:3]

    def command(self, trajectory: Trajectory) -> None:
        """Lead the servos along the trajectory and hold its end for a tenth of a second.

        Raises:
            DriverError: the simulation diverged.
        """
        dt = self.twin.machine.timestep
        times = np.arange(0.0, trajectory.duration + SETTLING, dt)
        # led by velocity too, as far as the servos damp it
        led = trajectory.positions + self._kv / self._kp * trajectory.velocities
        led, wanted = (
            np.column_stack([np.interp(times, trajectory.times, column) for column in values.T])
            for values in (led, trajectory.positions)
        )
        result = self.twin.advance(led[None, 1:], len(led) - 1)
        if self.twin.diverged[0]:
            raise DriverError("the simulation diverged")
        angles, forces = result.joints[0], result.wrench[0, :, :3] - self._weight
        self._force = forces[np.argmax(np.linalg.norm(forces, axis=1))]
        self.errors = (angles - wanted[:-1])[times[:-1] <= trajectory.duration]
        rates = np.gradient(angles, dt, axis=0)
        limit = self.twin.machine.servos.torque_limit
        self.torques = np.clip(self._kp * (led[1:] - angles) - self._kv * rates, -limit, limit)

    def joints(self) -> Floats:
        """Measured angles (6,), rad."""
        joints: Floats = self.twin.readings().joints[0]
        return joints

    def force(self) -> Floats:
        """The largest force on the peg since the last command, without its weight, (3,), N."""
        return self._force

    def miss(self, hole: int) -> tuple[float, float]:
        """The peg's true errors: its tip's distance from a hole's mouth, m, and tilt to it, rad."""
        now, task = self.twin.readings(), self.twin.machine.task
        normal = now.rotation[0] @ task.hole_normals[hole]
        gap = now.tip[0] - now.platform[0] - task.dome_radius * normal
        return float(np.linalg.norm(gap)), float(np.arccos(np.clip(normal[2], -1.0, 1.0)))


class Replayed(NamedTuple):
    """How a policy drove a machine; ``stopped`` is ``"filled"`` or the reason why it stopped."""

    stopped: str
    filled: list[int]
    moves: int
    seconds: float
    force: float  # the largest, N
    error: float  # the largest at the end of a move, rad


def replay(
    policy: MachinePolicy,
    driver: Driver,
    machine: Machine | None = None,
    *,
    target: int,
    holes: int | None = None,
    max_moves: int = 300,
    force_limit: float = 40.0,
    error_limit: float = 0.05,
    patience: float = 2.0,
    **arguments: Any,
) -> Replayed:
    """Let a policy of the kinematic task drive a machine, move by move, by what it reports.

    The measured joints give the configuration, and that observation and masks. A hole is filled
    where commanded and measured joints both meet the criterion. A move is commanded only if it is
    valid and its whole way is free.

    Args:
        policy: from observation and action masks to an action.
        driver: of the machine.
        machine: its nominal dimensions; None, the standard ones.
        target: the first hole to fill.
        holes: how many to fill; None, all active ones.
        max_moves: that are made at most.
        force_limit: N; beyond it the machine is not moved any more.
        error_limit: rad by which a joint may miss the end of a move.
        patience: s that an answer may take, and a command more than its trajectory.
        arguments: of :class:`~coop_env.env.CoopInsertionEnv`, as the policy was trained, but the
            dimensions and what needs a memory.

    Raises:
        DriverError: no answer came in time, or none of six finite angles or three finite forces.
        ArgumentError: an argument is wrong or needs a memory; nothing was commanded.
    """
    if wrong := [name for name in MEMORIES if arguments.get(name)]:
        raise ArgumentError(f"{wrong[0]}: a replay knows of no move but the present one")
    if arguments.get("observation") == "markov":
        raise ArgumentError("observation = 'markov': a replay does not know the episode's time")
    m = Machine() if machine is None else machine
    geometries: dict[str, Any] = {"geometry": m.rrs, "delta": m.delta, "task": m.task}
    if wrong := [name for name in geometries if name in arguments]:
        raise ArgumentError(f"{wrong[0]}: the machine has it")
    env = CoopInsertionEnv(**geometries, **arguments)
    most = sum(m.task.active_holes(env.stage))
    check_integer("target", target, 0, most - 1, hint=", an active hole")
    check_integer("max_moves", max_moves, 1)
    limits = {"force_limit": force_limit, "error_limit": error_limit, "patience": patience}
    for name, limit in limits.items():
        check_number(name, limit, 0.0, above=True)
    wanted_holes = most if holes is None else check_integer("holes", holes, 1, most)
    filled: list[int] = []
    seconds = force = error = 0.0
    where, moves = _stand(driver, m, m.home(), patience), 0

    def end(stopped: str) -> Replayed:
        return Replayed(stopped, filled, moves, seconds, force, error)

    while moves < max_moves:
        try:
            start = {"configuration": where, "target": target, "filled": filled}
            observation, _ = env.reset(options=start)
        except ResetOptionError as refused:
            return end(f"the machine stands where it must not: {refused}")
        *_, info = env.step(policy(observation, env.action_masks()))
        if info["violation"] or info["singular"]:
            return end("the move is not allowed")
        way = make_trajectory([where, env.configuration], m.rrs, m.delta, m.task)
        if blocked := way.blocked():
            return end(f"on the way there is {blocked[0][1]}")
        if (off := _off(driver, way.positions[0], patience)) > error_limit:
            return end(f"the way begins {off:.3g} rad from where the joints are")
        _ask(driver.command, way, seconds=way.duration + patience)
        moves, seconds = moves + 1, seconds + way.duration
        felt = float(np.linalg.norm(_numbers(driver.force, 3, patience)))
        where = _stand(driver, m, env.configuration, patience)
        off = _off(driver, way.positions[-1], patience)
        force, error = max(force, felt), max(error, off)
        if felt > force_limit:
            return end(f"a force of {felt:.3g} N")
        if off > error_limit:
            return end(f"a joint is {off:.3g} rad off its command")
        after = int(env.state["target"])
        if info["inserted"] and _meets(env, where, target, filled):
            filled.append(target)
        if len(filled) >= wanted_holes:
            return end("filled")
        target = after if target in filled else target
    return end("no moves are left")


def _meets(env: CoopInsertionEnv, where: Floats, target: int, filled: Sequence[int]) -> bool:
    """Whether the criterion holds at a configuration (6,), which is measured."""
    try:
        env.reset(options={"configuration": where, "target": target, "filled": filled})
    except ResetOptionError:  # which ends the replay
        return False
    near, state = env.task, env.state
    return bool(state["distance"] < near.tolerance and state["angle"] < near.angle_tolerance)


def _stand(driver: Driver, m: Machine, near: Sequence[float] | Floats, patience: float) -> Floats:
    """The configuration (6,) of the measured joints, the 3-RRS's branch followed from ``near``."""
    result = closed_at(_numbers(driver.joints, N_AXES, patience), near, m)
    result[5] = np.clip(result[5], m.rrs.heave_min, m.rrs.heave_max)  # it rests at a limit
    return result


def _off(driver: Driver, joints: Floats, patience: float) -> float:
    """Largest error of a measured joint, rad."""
    return float(np.abs(_numbers(driver.joints, N_AXES, patience) - joints).max())


def _numbers(call: Callable[[], Any], n: int, seconds: float) -> Floats:
    answer = _ask(call, seconds=seconds)
    try:
        result = np.asarray(answer, np.float64)
    except (TypeError, ValueError):
        raise DriverError(f"the machine answered {answer!r}: must be {n} numbers") from None
    if result.shape != (n,) or not np.isfinite(result).all():
        raise DriverError(f"the machine answered {result.tolist()}: must be {n} finite numbers")
    return result


def _ask(call: Callable[..., Any], *arguments: Any, seconds: float) -> Any:
    """Result of a call in its own thread, or its error; DriverError after ``seconds``."""
    answer: Future[Any] = Future()

    def work() -> None:
        try:
            answer.set_result(call(*arguments))
        except Exception as error:
            answer.set_exception(error)

    threading.Thread(target=work, daemon=True).start()
    if not wait([answer], min(seconds, threading.TIMEOUT_MAX)).done:
        name = getattr(call, "__name__", "a call")
        raise DriverError(
            f"the machine did not answer {name} within {seconds:.3g} s; its last command holds"
        )
    return answer.result()
