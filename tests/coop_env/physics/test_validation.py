"""The twin against the analytic kinematics: poses, loops, torques, energy, speed of mass."""

import mujoco
import numpy as np
import pytest

from coop_env.geometry import INITIAL, DeltaGeometry, RRSGeometry
from coop_env.kinematics import delta, rrs
from coop_env.physics.model import Machine, Servos
from coop_env.physics.twin import Twin, closed_at, last
from coop_env.physics.validation import draw_poses, validate

OTHER = Machine(
    rrs=RRSGeometry(base_radius=0.19, proximal_length=0.1, platform_radius=0.11),
    delta=DeltaGeometry(proximal_length=0.22, distal_length=0.5, base_height=0.9),
)
WIDE = Machine(delta=DeltaGeometry(0.474, 0.09, 0.182, 0.341, base_height=0.84))


@pytest.mark.parametrize("machine", [Machine(), Machine(rrs=INITIAL), OTHER])
def test_it_comes_to_rest_where_the_kinematics_say(machine: Machine) -> None:
    twin = Twin(machine, n=20)
    result = validate(twin, draw_poses(twin, 100 if machine is not OTHER else 20, seed=0))
    assert result.tip.max() < 5e-5
    assert np.degrees(result.platform.max()) < 0.05
    assert result.loop.max() < 1e-6
    assert np.degrees(result.joints.max()) < 0.01


def test_a_wide_deltas_cranks_fold_as_far_inwards_as_its_kinematics() -> None:
    twin, there = Twin(WIDE), np.array([-0.006, -0.0515, -0.3007, 0.0, 0.0, 0.21])
    assert delta.is_valid(there[:3], WIDE.delta)
    assert np.degrees(delta.inverse(there[:3], WIDE.delta).theta.max()) > 140.0
    twin.place(0, there)
    readings = last(twin.advance(twin.servo_targets(there)[None], 500))
    assert closed_at(readings.joints, there[None], WIDE)[0] == pytest.approx(there, abs=5e-5)


def test_under_its_own_weight_it_sags_along_its_kinematics() -> None:
    """No compensation: joints give way, and the tip is where the joints measured say it is."""
    twin = Twin(Machine(servos=Servos(gravity_compensation=False)))
    home = twin.machine.home()
    readings = last(twin.advance(twin.servo_targets(home)[None], 1500))
    believed = closed_at(readings.joints, home[None], twin.machine)[0]
    assert 1e-4 < home[2] - believed[2] < 5e-3
    height = twin.machine.delta.base_height - twin.machine.delta.peg_length
    assert np.linalg.norm(readings.tip[0] - believed[:3] - [0, 0, height]) < 5e-5
    pose = rrs.platform_pose(believed[3:])
    assert np.linalg.norm(readings.platform[0] - pose.position) < 5e-5


def test_servo_torques_are_the_gradient_of_the_potential_energy() -> None:
    """Virtual work, from energies at neighbouring poses of the kinematics alone."""
    twin = Twin(Machine(servos=Servos(gravity_compensation=False, delta_stiffness=500.0)))

    def potential_energy(configuration: np.ndarray) -> float:
        twin.place(0, configuration)
        model, data = twin.inspect(0)
        return float(9.81 * np.sum(model.body_mass * data.xipos[:, 2]))

    pose = np.array([0.03, -0.02, -0.38, 0.2, -0.1, 0.22])
    twin.place(0, pose)
    readings = last(twin.advance(twin.servo_targets(pose)[None], 1500))
    held = twin.inspect(0)[1].actuator_force.copy()
    rest = closed_at(readings.joints, pose[None], twin.machine)[0]
    steps = 1e-5 * np.eye(6)
    slope = [(potential_energy(rest + s) - potential_energy(rest - s)) / 2e-5 for s in steps]
    moved = rrs.jacobian(rest[3:]) @ rrs.twist_matrix(rest[3:])  # qdot per (roll, pitch, heave)dot
    turned = delta.jacobian(rest[:3]) / twin.machine.delta.proximal_length
    expected = [*np.linalg.solve(turned.T, slope[:3]), *np.linalg.solve(moved.T, slope[3:])]
    assert held == pytest.approx(expected, rel=2e-3, abs=2e-3)


def test_energy_only_changes_hands_when_nothing_drives_it() -> None:
    """Servos off, loops closed, falling for a tenth of a second: kinetic and potential energy."""
    twin = Twin(Machine(servos=Servos(gravity_compensation=False)))
    twin.place(0, [0.02, 0.0, -0.36, 0.2, 0.1, 0.23])
    model, data = twin.inspect(0)
    model.actuator_gainprm[:] = 0.0
    model.actuator_biasprm[:] = 0.0
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    mujoco.mj_forward(model, data)
    before = data.energy.copy()
    mujoco.mj_step(model, data, nstep=50)
    mujoco.mj_forward(model, data)
    exchanged = abs(data.energy[0] - before[0])
    assert exchanged > 0.05
    assert abs(data.energy.sum() - before.sum()) < 0.02 * exchanged
