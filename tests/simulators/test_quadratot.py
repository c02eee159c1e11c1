"""The model of QuadraTot, a real quadruped of nine servos."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from neurosim.base.errors import FileError, UserError
from neurosim.controllers.sine_gait import SineGait
from neurosim.loop.evaluate import Evaluator, evaluate
from neurosim.robots.quadratot import FRAME, JOINTS, LEGS, READY, angles_of
from neurosim.simulators import read_simulator
from neurosim.tasks.walking import Walking

mujoco = pytest.importorskip("mujoco", reason="pip install 'neurosim[mujoco]'")

from neurosim.simulators.legged.build import compile_model  # noqa: E402
from neurosim.simulators.legged.quadratot import QuadraTot  # noqa: E402
from neurosim.simulators.legged.simulator import LeggedSimulator  # noqa: E402

GAIT = SineGait(4.0)
GENES = GAIT.from_named(
    {"amp": 250.0, "tau": 1.2, "scale_in_out": 1.2, "mult_fb": -0.6, "mult_lr": 0.4}
)


@pytest.fixture(scope="module")
def simulator():
    return LeggedSimulator(QuadraTot())


@pytest.fixture
def task():
    return Walking(seconds=4.0, step=FRAME, stall=0.0)


@pytest.fixture(scope="module")
def crouching(simulator):
    """MuJoCo's data of a robot that crouches at the origin."""
    data = mujoco.MjData(simulator.model)
    state = simulator.physics.standing(np.zeros((1, 3)))[0]
    mujoco.mj_setState(simulator.model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    mujoco.mj_forward(simulator.model, data)
    return data


def test_mass_and_servos_are_those_of_the_paper(simulator):
    model = simulator.model
    assert model.body_subtreemass[0] == pytest.approx(1.88)
    assert [model.actuator(n).name for n in range(model.nu)] == list(JOINTS)
    assert model.nu == 9
    assert model.opt.timestep == 0.005
    assert simulator.command_names == (*JOINTS, "duration")
    legs = [model.body(f"right_rear_{part}").mass[0] for part in ("hip", "knee")]
    assert sum(legs) == pytest.approx(0.24)


def test_its_size_in_the_crouch_is_about_that_of_the_paper(simulator, crouching):
    """About 38 cm from leg to opposite leg; ours are 33 apart. The belly is on the floor."""
    ends = []
    for leg in LEGS:
        geom = simulator.model.geom(f"{leg}_lower").id
        axis = crouching.geom_xmat[geom].reshape(3, 3)[:, 2]
        centre, half = crouching.geom_xpos[geom], simulator.model.geom_size[geom, 1]
        tips = [centre + side * half * axis for side in (-1.0, 1.0)]
        ends.append(min(tips, key=lambda tip: tip[2]))
    one, opposite = ends[0], ends[2]
    assert np.linalg.norm((one - opposite)[:2]) + 0.012 == pytest.approx(0.333, abs=0.001)
    touched = {simulator.model.geom(contact.geom2).name for contact in crouching.contact}
    assert touched == {"front", "rear"}
    joints = [crouching.joint(name).qpos[0] for name in JOINTS]
    np.testing.assert_allclose(joints, angles_of(READY), atol=0.05)


def test_a_leg_lifts_with_a_higher_inner_position_and_bends_with_a_lower_outer_one(simulator):
    def foot(inner, outer):
        data = mujoco.MjData(simulator.model)
        for joint, position in (("inner", inner), ("outer", outer)):
            place = simulator.model.joint(f"left_front_{joint}").qposadr[0]
            data.qpos[place] = angles_of(np.full(9, position))[0 if joint == "inner" else 1]
        mujoco.mj_forward(simulator.model, data)
        geom = simulator.model.geom("left_front_lower").id
        return data.geom_xpos[geom] - data.qpos[:3]

    flat = foot(512, 512)
    assert flat[0] == pytest.approx(flat[1] - 0.006)  # along the diagonal of the left front hip
    assert foot(600, 512)[2] > flat[2] + 0.03
    assert foot(512, 400)[2] < flat[2] - 0.03


def test_standing_still_it_stays_where_it_was_put(simulator):
    start = np.array([[1.0, 2.0, 0.5]])
    poses = simulator.physics.walk(simulator.model, start, np.tile(angles_of(READY), (1, 80, 1)))
    np.testing.assert_allclose(poses[0, -1], start[0], atol=1e-3)


def test_a_servo_is_no_faster_than_its_limit():
    """A flat leg that is commanded to fold by 2.07 rad takes 0.71 s at 2.9 rad/s."""
    model = compile_model(QuadraTot(gravity=0.0))
    data = mujoco.MjData(model)
    data.qpos[2] = 1.0
    goal = angles_of(np.array([512, 150] * 4 + [512]))
    place = model.joint("left_front_outer").qposadr[0]
    for _ in range(100):  # half a second
        data.ctrl[:] = goal
        mujoco.mj_step(model, data)
    assert data.qpos[place] == pytest.approx(-2.9 * 0.5, abs=0.2)
    for _ in range(100):
        mujoco.mj_step(model, data)
    assert data.qpos[place] == pytest.approx(goal[1], abs=0.1)


def test_the_same_gait_goes_the_same_way_and_a_gait_goes_somewhere(simulator, task):
    result = evaluate(simulator, task, GAIT)(np.stack([GENES, GENES]))
    again = evaluate(LeggedSimulator(QuadraTot()), task, GAIT)(GENES)
    assert result[0] == result[1] == again
    assert 0.005 < again < 0.2


def test_compiled_rollouts_are_the_steps(simulator):
    task, gait = Walking(seconds=3.0, step=FRAME, stall=0.0), SineGait(3.0)
    whole = Evaluator(simulator, task, gait)
    stepped = Evaluator(simulator, task, gait, stepped=True)
    draws = whole.expectation()
    one, other = whole.run(GENES[None], draws), stepped.run(GENES[None], draws)
    np.testing.assert_allclose(one.commands, other.commands[..., :9], atol=1e-12)
    # Friction is solved by iterations that begin with the previous step's result, or from nothing.
    np.testing.assert_allclose(one.poses, other.poses, atol=5e-3)


def test_every_parameter_matters(simulator, task):
    values = [one.value for one in simulator.parameters]
    expected = evaluate(simulator, task, GAIT)(GENES)
    assert [one.name for one in simulator.parameters] == list(QuadraTot.ranges)
    for place, one in enumerate(simulator.parameters):
        changed = np.array(values)
        changed[place] = one.at(0.1)
        assert evaluate(simulator.adjusted(changed), task, GAIT)(GENES) != expected, one.name


def test_an_adjusted_robot_stands_by_its_own_measures(simulator):
    """A belly that reaches down by 5 mm less lies 5 mm lower."""
    values = np.array([one.value for one in simulator.parameters])
    place = list(QuadraTot.ranges).index("belly")
    values[place] -= 0.005
    lower = simulator.adjusted(values)
    assert lower.physics is simulator.physics
    heights = [
        simulator.physics.standing(np.zeros((1, 3)), one.model)[0, 3] for one in (simulator, lower)
    ]
    assert heights[0] - heights[1] == pytest.approx(0.005, abs=5e-4)


def test_parameters_out_of_bounds_are_refused(simulator):
    values = np.array([one.value for one in simulator.parameters])
    values[list(QuadraTot.ranges).index("torque")] = 3.0
    with pytest.raises(UserError, match=r"torque is 3, outside of 0\.6 to 1\.8 N m"):
        simulator.adjusted(values)
    with pytest.raises(UserError, match="expected 14 parameters"):
        simulator.adjusted(values[:5])
    with pytest.raises(UserError, match=r"the timestep must divide 0\.025 s evenly"):
        QuadraTot(timestep=0.008)
    with pytest.raises(UserError, match=r"a leg of 0\.5 kg does not fit a robot of 1\.88 kg"):
        QuadraTot(leg=0.5)


def test_commands_that_are_too_short_are_refused(simulator):
    with pytest.raises(UserError, match=r"get a command every 0\.025 s; 0\.008 s is too short"):
        evaluate(simulator, Walking(seconds=4.0), GAIT)(GENES)


def test_a_copy_goes_the_same_way(simulator, task):
    again = pickle.loads(pickle.dumps(simulator))
    assert again.command_names == simulator.command_names
    assert evaluate(again, task, GAIT)(GENES) == evaluate(simulator, task, GAIT)(GENES)


def test_it_is_written_and_read(tmp_path, simulator):
    made = LeggedSimulator(replace(simulator.build, friction=0.5))
    made.write(tmp_path / "simulator")
    again = read_simulator(tmp_path / "simulator")
    assert again.build == made.build
    path = tmp_path / "simulator" / "simulator.json"
    path.write_text(path.read_text().replace('"quadratot"', '"octopus"'))
    with pytest.raises(FileError, match=r"simulator\.json.*robot"):
        read_simulator(tmp_path / "simulator")
