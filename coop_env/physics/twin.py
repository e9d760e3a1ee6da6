"""The simulation: n machines side by side, stepped by MuJoCo's own threads.

One machine is a batch of one, so the single environment and the vectorised one run the same code
and come to the same last bit.
"""

import copy
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from gymnasium.error import ClosedEnvironmentError
from numpy.typing import ArrayLike, NDArray

from coop_env.errors import ArgumentError, check_integer, imports
from coop_env.kinematics import delta, rrs
from coop_env.kinematics.delta_kernels import DeltaParams
from coop_env.kinematics.rotations import roll_pitch_yaw_matrix
from coop_env.kinematics.rrs_kernels import RRSParams
from coop_env.physics.joints import Floats, platform_mount, tree_angles
from coop_env.physics.model import LOOP_TIME, Machine, build_mjcf, to_xml
from coop_env.simulation.collision import peg_tip
from coop_env.simulation.sim_to_real import MASSES, Disturbance
from coop_env.simulation.task import N_AXES, pack

with imports("the physics twin needs", "physics"):
    import mujoco
    import mujoco.rollout

_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
_SETTLING = 1.0  # s in which servos have to show that they hold home


class Readings(NamedTuple):
    """Sensor readings, with any leading axes; N, N m, rad, m, world frame.

    ``wrench`` is what the peg does to the effector, force and moment about the tip, by contact and
    its own weight, in the peg's frame. ``joints`` are theta and q. ``tip``, ``platform`` (its
    centre) and ``rotation`` are where things really are, at the beginning of a timestep.
    """

    wrench: Floats  # (..., 6)
    joints: Floats  # (..., 6)
    tip: Floats  # (..., 3)
    platform: Floats  # (..., 3)
    rotation: Floats  # (..., 3, 3)


def _readings(sensors: Floats) -> Readings:
    """Sensor data (..., 27) by name, in the order in which the model has them."""
    rotation = np.swapaxes(sensors[..., 18:].reshape(*sensors.shape[:-1], 3, 3), -1, -2)
    # the engine's own wrench is what the effector does to the peg
    parts = -sensors[..., :6], sensors[..., 6:12], sensors[..., 12:15], sensors[..., 15:18]
    return Readings(*parts, rotation)


def last(readings: Readings) -> Readings:
    """The last of (n, steps) readings, (n, ...)."""
    return Readings(*(part[:, -1] for part in readings))


def make_model(machine: Machine) -> Any:
    """MuJoCo's model of a machine, compiled.

    Raises:
        GeometryError: a robot cannot be assembled at home.
        ArgumentError: the holes do not fit the dome.
    """
    return mujoco.MjModel.from_xml_string(to_xml(build_mjcf(machine)))


class Twin:
    """``n`` machines of one kind, each with its own state, base and friction.

    ``threads`` of MuJoCo's pool step them, 1 the caller's thread.

    Raises:
        GeometryError: a robot cannot be assembled at home.
        ArgumentError: the holes do not fit the dome, or the servos cannot hold home.
    """

    def __init__(self, machine: Machine | None = None, n: int = 1, threads: int = 1) -> None:
        self.machine = Machine() if machine is None else machine
        self.n = check_integer("n", n, 1)
        self.packed = pack(self.machine.kernel_params())
        self._nominal = first = make_model(self.machine)
        self.models: list[Any] = [copy.copy(first) for _ in range(n)]
        self.machines = [self.machine] * n
        """The true machines; ``machine`` is the nominal one of all."""
        self._start_threads(check_integer("threads", threads, 1))
        self._base, self._peg = first.body("rrs_base").id, first.geom("peg").id
        self.states: Floats = np.zeros((n, mujoco.mj_stateSize(first, _STATE)))
        self._sensors: Floats = np.zeros((n, first.nsensordata))
        self._controls: Floats = np.zeros((n, first.nu))  # what the servos were told last
        self.base: Floats = np.zeros((n, 5))
        self._turns: Floats = np.zeros((n, 3, 3))
        self.diverged: NDArray[np.bool_] = np.zeros(n, bool)
        home = self.machine.home()
        self._home_angles = np.tile(self.servo_targets(home), (n, 1))
        for row in range(n):
            self.place(row, home)
        self._check_hold(home)

    def _start_threads(self, threads: int) -> None:
        self._data = [mujoco.MjData(self.models[0]) for _ in range(threads)]
        self._pool = mujoco.rollout.Rollout(nthread=threads if threads > 1 else 0)

    def __getstate__(self) -> dict[str, Any]:
        """The state to pickle and copy: everything but threads and their data."""
        return {**self.__dict__, "_data": None, "_pool": None, "_threads": len(self._data)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        threads = state.pop("_threads")
        self.__dict__.update(state)
        self._start_threads(threads)

    def disturb(self, row: int, errors: Disturbance) -> None:
        """Give one machine errors; call :meth:`place` after it.

        Raises:
            GeometryError: links of such lengths cannot be assembled at home.
        """
        real = self.machines[row] = _resized(self.machine, errors.lengths)
        model = copy.copy(self._nominal) if real is self.machine else make_model(real)
        self.models[row], self._home_angles[row] = model, joint_targets(real.home(), real)
        model.actuator_gainprm[:, 0] *= errors.gains
        model.actuator_biasprm[:, :2] *= errors.gains[:, None]
        model.actuator_biasprm[:, 2] *= np.sqrt(errors.gains)  # its damping goes with the root
        dofs = model.jnt_dofadr[model.actuator_trnid[:, 0]]
        model.dof_frictionloss[dofs] = errors.dead_zone
        # by default dry friction creeps: it lets go of half a dead zone within 0.1 s
        model.dof_solref[dofs, 0], model.dof_solimp[dofs, :2] = LOOP_TIME, 0.9999
        for name, factor in zip(MASSES, errors.masses, strict=True):
            bodies = [i for i in range(model.nbody) if model.body(i).name.startswith(name)]
            model.body_mass[bodies] *= factor
            model.body_inertia[bodies] *= factor
            model.body_gravcomp[bodies] /= factor  # gravity compensation knows the nominal mass
        mujoco.mj_setConst(model, self._data[0])

    def joint_positions(self, configuration: ArrayLike, machine: Machine | None = None) -> Floats:
        """Generalized coordinates (nq,) at a configuration (6,), by a machine's kinematics.

        Raises:
            ArgumentError: it is not six numbers that both robots can reach.
        """
        c = np.asarray(configuration, np.float64)
        m = self.machine if machine is None else machine
        angles = tree_angles(c, m.rrs, m.delta) if c.shape == (N_AXES,) else None
        if angles is None or not all(np.isfinite(part).all() for part in angles):
            raise ArgumentError(f"configuration = {configuration!r}: out of the robots' reach")
        at_home = platform_mount(tree_angles(m.home(), m.rrs, m.delta))
        turn = at_home @ platform_mount(angles).T @ angles.rotation
        q: Floats = np.zeros(self.models[0].nq)  # in the order of the tree: limbs, rods, effector
        q[[0, 6, 8]], q[[1, 7, 9]] = angles.q, angles.elbow
        mujoco.mju_mat2Quat(q[2:6], turn.ravel())  # on the end of limb 0
        q[10:19] = np.column_stack([angles.theta, angles.swing, angles.sway]).ravel()
        q[19:22] = c[:3]
        return q

    def servo_targets(self, configurations: ArrayLike) -> Floats:
        """Joint commands (..., 6), theta then q, rad; NaN where a robot cannot reach."""
        return joint_targets(configurations, self.machine)

    def place(
        self, row: int, configuration: ArrayLike, base: ArrayLike | None = None,
        friction: float | None = None,
    ) -> Readings:  # fmt: skip
        """Set one machine down at rest, and read its sensors.

        Args:
            row: which machine.
            configuration: (6,), by the nominal model's joints.
            base: where the 3-RRS's base really stands (5,): x, y, z, m; roll, pitch, rad.
            friction: of the peg; None leaves it.

        Raises:
            ArgumentError: the configuration is out of reach.
            ClosedEnvironmentError: :meth:`close` was called.
        """
        self.require_open()
        model = self.models[row]
        self.base[row] = 0.0 if base is None else base
        self._turns[row] = self._stand(model, self.base[row])
        if friction is not None:
            model.geom_friction[self._peg, 0] = friction
        joints, real = self.servo_targets(configuration), self.machines[row]
        if real is not self.machine:
            configuration = closed_at(joints, configuration, real)
        q = self.joint_positions(configuration, real)
        self.states[row] = 0.0
        self.states[row, 1 : 1 + q.size] = q
        self.diverged[row] = False
        self._controls[row] = joints - self._home_angles[row]
        self._sensors[row] = self.inspect(row)[1].sensordata
        return _readings(self._sensors[row].copy())

    def _stand(self, model: Any, base: ArrayLike) -> Floats:
        """Put a model's 3-RRS on its base (5,); returns the base's rotation (3, 3)."""
        x, y, z, roll, pitch = np.asarray(base, np.float64)
        turn = roll_pitch_yaw_matrix([roll, pitch, 0.0])
        model.body_pos[self._base] = x, y, z
        mujoco.mju_mat2Quat(model.body_quat[self._base], turn.ravel())
        return turn

    def overlap(self, configuration: ArrayLike, base: ArrayLike) -> tuple[str, str] | None:
        """Two bodies of the nominal machine that touch at a configuration (6,), None if none do.

        The kinematic model lacks some of them. No machine of the twin moves.
        """
        model = copy.copy(self._nominal)
        self._stand(model, base)
        data = mujoco.MjData(model)
        data.qpos[:] = self.joint_positions(configuration)
        mujoco.mj_fwdPosition(model, data)
        if not data.ncon:
            return None
        geoms = [model.geom(number) for number in data.contact[0].geom]
        one, other = (geom.name or model.body(geom.bodyid[0]).name for geom in geoms)
        return one, other

    def readings(self) -> Readings:
        """The last readings of all machines, (n, ...)."""
        return _readings(self._sensors.copy())

    def inspect(self, row: int) -> tuple[Any, Any]:
        """MuJoCo's own model and data of one machine now, all quantities computed.

        Later calls of the twin reuse the data: copy what is to stay.
        """
        model, data = self.models[row], self._data[0]
        mujoco.mj_setState(model, data, self.states[row], _STATE)
        data.ctrl[:] = self._controls[row]
        data.qacc_warmstart[:] = 0.0  # the solver would begin where another machine was
        mujoco.mj_forward(model, data)
        return model, data

    def advance(self, targets: ArrayLike, steps: int) -> Readings:
        """Move all machines for ``steps`` timesteps; ``diverged`` says which of them diverged.

        Those stay where they were, with the sensors' last good readings.

        Args:
            targets: joint commands (n, 6), held, or (n, steps, 6), rad.
            steps: how many timesteps.

        Returns:
            The readings, with leading axes (n, steps).

        Raises:
            ClosedEnvironmentError: :meth:`close` was called.
        """
        self.require_open()
        held = np.asarray(targets, np.float64)
        held = (held[:, None] if held.ndim == 2 else held) - self._home_angles[:, None]
        controls = np.ascontiguousarray(np.broadcast_to(held, (self.n, steps, N_AXES)))
        states = np.empty((self.n, steps, self.states.shape[1]))
        sensors = np.empty((self.n, steps, self._sensors.shape[1]))
        log = mujoco.get_mju_user_warning()  # the default one writes a file to the folder
        mujoco.set_mju_user_warning(lambda _: None)
        try:
            self._pool.rollout(
                self.models, self._data, self.states, controls, nstep=steps, state=states,
                sensordata=sensors, skip_checks=True,
            )  # fmt: skip
        finally:
            mujoco.set_mju_user_warning(log)
        # A rollout that meets a warning of the engine's stands still from there on.
        elapsed = states[:, -1, 0] - self.states[:, 0]
        whole = np.isfinite(states[:, -1]).all(axis=1) & np.isfinite(sensors).all(axis=(1, 2))
        self.diverged = gone = ~(whole & (elapsed > (steps - 0.5) * self.machine.timestep))
        if gone.any():
            sensors[gone], states[gone, -1] = self._sensors[gone][:, None], self.states[gone]
        self.states, self._sensors = states[:, -1].copy(), sensors[:, -1]
        self._controls = controls[:, -1].copy()
        return _readings(sensors)

    def platform_error(self, readings: Readings, configurations: Floats) -> Floats:
        """Angle (n,) between the platform and what configurations (n, 6) command of it, rad."""
        pose = rrs.platform_pose(configurations[:, 3:], self.machine.rrs)
        off = readings.rotation - self._turns @ pose.rotation
        chord = np.linalg.norm(off, axis=(-2, -1))  # sqrt(8) sin(angle / 2): exact also near zero
        return 2.0 * np.arcsin(np.minimum(chord / np.sqrt(8.0), 1.0))

    def errors(self, readings: Readings, configurations: Floats) -> tuple[Floats, Floats, Floats]:
        """How far the tip and the platform's centre, m, and the platform, rad, are off (n,)."""
        params = self.machine.kernel_params().delta
        tips = np.array([peg_tip(*c[:3].tolist(), params) for c in configurations])
        centres = rrs.platform_pose(configurations[:, 3:], self.machine.rrs).position
        tip = np.linalg.norm(readings.tip - tips, axis=1)
        centre = np.linalg.norm(readings.platform - centres, axis=1)
        return tip, centre, self.platform_error(readings, configurations)

    def require_open(self) -> None:
        """Raise ``ClosedEnvironmentError`` after :meth:`close`."""
        if self._pool is None:
            raise ClosedEnvironmentError("the simulation was closed: make the environment anew")

    def close(self) -> None:
        """End the threads; the machines move no more."""
        if self._pool is not None:
            self._pool.close()
        self._pool = None

    def _check_hold(self, home: Floats) -> None:
        """Check that the servos hold home within the task's insertion tolerances."""
        task, start, read = self.machine.task, self.states.copy(), self._sensors.copy()
        result = last(self.advance(self._home_angles, round(_SETTLING / self.machine.timestep)))
        sag, sunk, lean = (off[0] for off in self.errors(result, np.tile(home, (self.n, 1))))
        held = max(sag, sunk) < task.tolerance and lean < task.angle_tolerance
        if self.diverged[0] or not held:
            raise ArgumentError(
                f"these servos cannot hold the machine at home: within 1 s the tip is "
                f"{1e3 * sag:.3g} mm off, the platform {1e3 * sunk:.3g} mm and "
                f"{np.degrees(lean):.3g} degrees; raise the stiffness or torque_limit, or turn "
                "gravity_compensation on"
            )
        self.states, self._sensors = start, read


def joint_targets(configurations: ArrayLike, machine: Machine) -> Floats:
    """Joint angles (..., 6), theta then q, rad; NaN where a robot cannot reach."""
    c = np.asarray(configurations, np.float64)
    theta = delta.inverse(c[..., :3], machine.delta).theta
    return np.concatenate([theta, rrs.inverse(c[..., 3:], machine.rrs).q], axis=-1)


def closed_at(joints: ArrayLike, previous: ArrayLike, machine: Machine) -> Floats:
    """Configurations (..., 6) of joints theta and q (..., 6), NaN where the links cannot close.

    The 3-RRS's branch is followed from the configurations ``previous`` (..., 6).
    """
    angles, before = np.asarray(joints, np.float64), np.asarray(previous, np.float64)
    position = delta.forward(angles[..., :3], machine.delta).position
    pose = rrs.forward(angles[..., 3:], before[..., 3:], machine.rrs).pose
    return np.concatenate([position, pose], axis=-1)


def _resized(machine: Machine, factors: Floats) -> Machine:
    """The machine with its lengths times ``factors`` (8,), ordered as in MACHINE's ``lengths``."""
    if (factors == 1.0).all():
        return machine

    def scaled(robot: Any, names: tuple[str, ...], sizes: Floats) -> Any:
        pairs = zip(names[:4], sizes.tolist(), strict=True)
        return replace(robot, **{name: getattr(robot, name) * size for name, size in pairs})

    robot = scaled(machine.rrs, RRSParams._fields, factors[:4])
    return replace(
        machine, rrs=robot, delta=scaled(machine.delta, DeltaParams._fields, factors[4:])
    )
