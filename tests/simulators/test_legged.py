"""The walking robot: its simulator, its 12 parameters, and the task."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from neurosim.base.errors import FileError, UserError
from neurosim.base.trajectory import Trajectory
from neurosim.controllers.gait import HAND_TUNED, Gait, genes_of
from neurosim.loop.evaluate import Evaluator, evaluate
from neurosim.robots.quadruped import JOINTS, standing
from neurosim.simulators import read_simulator
from neurosim.tasks.walking import Walking

mujoco = pytest.importorskip("mujoco", reason="pip install 'neurosim[mujoco]'")

from neurosim.simulators.legged.build import Build, ServoBuild, compile_model  # noqa: E402
from neurosim.simulators.legged.physics import Physics, followed, poses_of  # noqa: E402
from neurosim.simulators.legged.simulator import LeggedSimulator  # noqa: E402

HAND = genes_of(HAND_TUNED)
PARAMETERS = tuple(Build.ranges)


@pytest.fixture(scope="module")
def simulator():
    return LeggedSimulator()


def test_the_hand_tuned_gait_walks_forward_at_about_its_ground_speed(simulator):
    evaluator = Evaluator(simulator, Walking(seconds=4.0), Gait())
    judged, trajectory = evaluator.judge(HAND[None], evaluator.expectation())
    assert judged.success.all()
    assert 0.08 < judged.fitness[0, 0] < 0.15
    end = trajectory.poses[0, 0, -1]
    assert end[0] > 0.3
    assert abs(end[1]) < 0.5 * end[0]


def test_servos_lag_and_have_a_largest_speed():
    """They move half of the remaining angle in a frame, 0.1 rad at most."""
    commands = np.tile(standing(), (2, 4, 1))
    commands[..., 0] += 0.3
    before, half, most = np.tile(standing(), (2, 1)), np.full(2, 0.5), np.array([0.1, np.inf])
    moved = followed(commands, before, half, most)[..., 0] - standing()[0]
    assert moved[0] == pytest.approx([0.1, 0.2, 0.25, 0.275])
    assert moved[1] == pytest.approx([0.15, 0.225, 0.2625, 0.28125])


def test_a_state_keeps_the_goals_of_servos():
    """Steps of one frame end where the whole walk does, but for how the solver begins."""
    simulator, gait = LeggedSimulator(ServoBuild()), Gait()
    commands = gait.over(HAND[None], np.arange(40) * 0.008)
    walked = simulator.physics.walk(simulator.model, np.zeros((1, 3)), commands)
    state = simulator.start(torch.zeros(1, 3))
    for frame in range(40):
        held = np.append(commands[0, frame], 0.008)
        state = simulator.step(state, torch.from_numpy(held)[None])
    assert state[0, :3].numpy() == pytest.approx(walked[0, -1], abs=1e-5)
    fast = LeggedSimulator(ServoBuild(speed=15.0, lag=0.003))
    ideal = fast.physics.walk(fast.model, np.zeros((1, 3)), commands)
    assert np.abs(ideal[0, -1] - walked[0, -1]).max() > 1e-3


def test_masses_and_inertias_are_those_of_the_build():
    light, heavy = (compile_model(Build(body=mass)) for mass in (0.4, 0.8))
    trunk = light.body("trunk").id
    assert light.body_mass[trunk] == pytest.approx(0.4)
    assert heavy.body_inertia[trunk] == pytest.approx(2.0 * light.body_inertia[trunk])
    legs = [light.body(f"left_front_{part}").mass[0] for part in ("hip", "knee")]
    assert sum(legs) == pytest.approx(0.15)
    assert [light.actuator(n).name for n in range(12)] == list(JOINTS)


def test_it_stands_with_its_feet_on_the_floor(simulator):
    poses = simulator.physics.walk(
        simulator.model, np.array([[1.0, 2.0, 0.5]]), np.tile(standing(), (1, 250, 1))
    )
    np.testing.assert_allclose(poses[0, -1], [1.0, 2.0, 0.5], atol=0.01)
    lowest = mujoco.MjData(simulator.model)
    state = simulator.physics.standing(np.zeros((1, 3)))[0]
    mujoco.mj_setState(simulator.model, lowest, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    mujoco.mj_forward(simulator.model, lowest)
    assert lowest.ncon == 0 or min(lowest.contact.dist) > -1e-9
    lowest.qpos[2] -= 0.001
    mujoco.mj_forward(simulator.model, lowest)
    assert min(lowest.contact.dist) == pytest.approx(-0.001)


def test_compiled_rollouts_are_the_steps(simulator):
    task = Walking(seconds=1.0)
    genes = np.stack([HAND, np.clip(HAND + 0.05, 0.0, 1.0)])
    whole = Evaluator(simulator, task, Gait())
    stepped = Evaluator(simulator, task, Gait(), stepped=True)
    draws = whole.expectation()
    one, other = whole.run(genes, draws), stepped.run(genes, draws)
    np.testing.assert_allclose(one.commands, other.commands, atol=1e-12)
    # Friction is solved by iterations that begin with the previous step's result, or from nothing.
    np.testing.assert_allclose(one.poses, other.poses, atol=2e-3)


def test_threads_change_nothing():
    model = compile_model(Build())
    commands = Gait().over(np.stack([HAND, HAND * 0.9]), np.arange(100) * 0.008)
    out = [Physics(model, threads).walk(model, np.zeros((2, 3)), commands) for threads in (1, 2)]
    np.testing.assert_array_equal(out[0], out[1])


def test_every_parameter_matters(simulator):
    task, values = Walking(seconds=2.0), [one.value for one in simulator.parameters]
    expected = evaluate(simulator, task, Gait())(HAND)
    assert [one.name for one in simulator.parameters] == list(PARAMETERS)
    assert len(PARAMETERS) == 12
    for place, one in enumerate(simulator.parameters):
        changed = np.array(values)
        changed[place] = one.at(0.1)
        assert evaluate(simulator.adjusted(changed), task, Gait())(HAND) != expected, one.name


def creep(axis, **build):
    """Return how fast feet creep along x or y for each newton that pulls at the trunk, m/s."""
    speeds = []
    for force in (0.0, 0.5, 1.0):
        model = compile_model(Build(timestep=0.001, **build))
        data = mujoco.MjData(model)
        data.qpos[7:] = standing()
        data.qpos[2] = 0.12
        for step in range(1500):
            data.ctrl[:] = standing()
            data.xfrc_applied[model.body("trunk").id, axis] = force * (step >= 500)
            mujoco.mj_step(model, data)
            if step == 1000:
                begin = data.qpos[axis]
        speeds.append((data.qpos[axis] - begin) / 0.5)
    assert speeds[2] - speeds[0] == pytest.approx(2.0 * (speeds[1] - speeds[0]), rel=0.05)
    return speeds[2] - speeds[0]


def test_a_foot_creeps_by_force_times_the_time_constant():
    slow, fast = creep(0, slip=0.05), creep(0, slip=0.1)
    assert slow > 1e-4
    assert fast == pytest.approx(2.0 * slow, rel=0.15)


def test_slip_ratio_is_how_much_more_a_foot_creeps_to_the_side():
    ahead, aside = (creep(axis, slip=0.05, slip_ratio=1.0) for axis in (0, 1))
    assert aside == pytest.approx(ahead, rel=0.15)
    assert creep(1, slip=0.05, slip_ratio=4.0) == pytest.approx(4.0 * aside, rel=0.15)
    assert creep(0, slip=0.05, slip_ratio=4.0) == pytest.approx(ahead, rel=0.02)


def test_a_fall_has_no_pose_and_no_speed(simulator):
    """The left legs are folded at once: the robot falls onto its side."""
    command = standing().reshape(4, 3)
    command[::2, 2] = 2.3 * np.sign(command[::2, 2])
    commands = np.tile(command.ravel(), (1, 250, 1))
    poses = simulator.physics.walk(simulator.model, np.zeros((1, 3)), commands)
    fallen = np.zeros((1, 251, 3))
    fallen[:, :, 0] = np.linspace(0, 1, 251)
    fallen[0, 100:] = np.nan
    judged = Walking(2.0).judge(Trajectory(fallen, commands, 0.008))
    assert judged.fitness[0] == 0.0
    assert not judged.success[0]
    assert Walking.reasons[judged.reason[0]] == "fell"
    assert judged.segment[0] == 99
    assert np.isfinite(poses[0, :20]).all()
    assert np.isnan(poses[0, 100:]).all()


def test_what_has_fallen_or_flies_is_lost():
    """Rolled by 59 and by 61 degrees at 5 cm; upright at 34 and at 36 cm."""

    def state(roll, height):
        half = 0.5 * np.radians(roll)
        return [1.0, 0.0, 0.0, height, np.cos(half), np.sin(half), 0.0, 0.0]

    states = np.array([state(59, 0.05), state(61, 0.05), state(0, 0.34), state(0, 0.36)])
    seen = poses_of(states[:, None], np.zeros((4, 3)))
    assert np.isnan(seen[:, 0, 0]).tolist() == [False, True, False, True]


def test_a_model_that_blows_up_falls_and_does_not_disturb_the_others(tmp_path, monkeypatch):
    """MuJoCo stops such a trial, and would restart it at its first position."""
    monkeypatch.chdir(tmp_path)  # it leaves a log
    wild, tame = compile_model(Build(p=1e9, d=0.0, torque=1e9)), compile_model(Build())
    commands = np.tile(standing() + 0.3, (2, 200, 1))
    physics = Physics(tame, 2)
    poses = physics.walk([wild, tame], np.zeros((2, 3)), commands)
    assert np.isfinite(poses[:, 0]).all()
    assert np.isnan(poses[0, 2:]).all()
    assert np.isfinite(poses[1]).all()
    assert np.isnan(physics.frames(tame, np.full((1, physics.size), np.nan), commands[:1])).all()
    assert not list(tmp_path.iterdir())


def test_numbers_that_blow_up_are_a_fall():
    states = np.full((1, 3, 20), 0.1)
    states[..., 4], states[..., 5:8] = 1.0, 0.0
    states[0, 1, 12] = np.inf
    seen = poses_of(states, np.zeros((1, 3)))
    assert np.isfinite(seen[0, 0]).all()
    assert np.isnan(seen[0, 1:]).all()


def test_walking_is_displacement_by_time_and_a_stall_is_a_failure():
    poses = np.zeros((2, 251, 3))
    poses[0, :, 0], poses[0, :, 1] = np.linspace(0, 0.3, 251), np.linspace(0, 0.4, 251)
    poses[1, :, 0] = np.linspace(0, 0.01, 251)
    judged = Walking(2.0).judge(Trajectory(poses, np.zeros((2, 250, 12)), 0.008))
    assert judged.fitness == pytest.approx([0.25, 0.0])
    assert judged.success.tolist() == [True, False]
    assert Walking.reasons[judged.reason[1]] == "did not walk"


def test_a_trial_ends_at_the_circle(simulator):
    """Two robots at 0.5 m/s: one falls after a second, the other reaches the circle at 1.2 s."""
    poses = np.zeros((2, 251, 3))
    poses[:, :, 0] = np.linspace(0, 1, 251)
    poses[0, 126:] = poses[1, 200:] = np.nan
    judged = Walking(2.0, circle=0.6).judge(Trajectory(poses, np.zeros((2, 250, 12)), 0.008))
    assert judged.fitness == pytest.approx([0.0, 0.5])
    assert judged.success.tolist() == [False, True]
    assert judged.segment.tolist() == [125, 149]
    assert judged.over.all()
    assert judged.progress == pytest.approx([0.0, 0.5])
    # In the simulator the robot stands there from then on; up to there nothing else changes.
    whole, ended = (
        Evaluator(simulator, Walking(4.0, circle=circle), Gait()) for circle in (0.0, 0.2)
    )
    (far,), (near,) = (one.run(HAND[None], one.expectation()).poses[0] for one in (whole, ended))
    away = np.hypot(far[:, 0], far[:, 1])
    first = int((away >= 0.2).argmax())
    assert 0 < first < 499
    np.testing.assert_array_equal(near[: first + 1], far[: first + 1])
    assert (near[first:] == near[first]).all()
    fitness = ended.judge(HAND[None], ended.expectation())[0].fitness[0, 0]
    assert fitness == pytest.approx(0.2 / (0.008 * first))


def test_parameters_out_of_bounds_are_refused(simulator):
    values = np.array([one.value for one in simulator.parameters])
    values[PARAMETERS.index("friction")] = 3.0
    with pytest.raises(UserError, match=r"friction is 3, outside of 0\.3 to 1\.5"):
        simulator.adjusted(values)
    with pytest.raises(UserError, match="expected 12 parameters"):
        simulator.adjusted(values[:5])
    with pytest.raises(UserError, match=r"gravity is 0, outside of 8 to 11\.5 m/s\^2"):
        LeggedSimulator(Build(gravity=0.0))


@pytest.mark.parametrize(
    ("change", "message"),
    [({"timestep": 0.003}, r"must divide 0\.008 s evenly, not 0\.003 s"),
     ({"timestep": 0.016}, "must divide"), ({"timestep": 0.0}, "timestep: expected"),
     ({"iterations": 0}, "iterations: expected"), ({"cone": "round"}, "cone: expected one of")],
)  # fmt: skip
def test_physics_that_cannot_be_is_refused(change, message):
    with pytest.raises(UserError, match=message):
        Build(**change)


def test_a_command_is_held_for_its_duration(simulator):
    """Every row for its own; 24 ms are three frames."""
    start = simulator.start(torch.zeros(2, 3, dtype=torch.float64))
    angles = torch.from_numpy(np.tile(standing() + 0.1, (2, 1)))
    times = torch.tensor([[0.024], [0.008]], dtype=torch.float64)
    after = simulator.step(start, torch.cat([angles, times], dim=1))
    assert after[:, 3].tolist() == pytest.approx([0.024, 0.008])  # MuJoCo's clock
    again = start[1:]
    for _ in range(3):
        again = simulator.step(again, torch.cat([angles, times], dim=1)[1:])
    np.testing.assert_allclose(again[0, :3], after[0, :3], atol=1e-5)


def test_it_is_written_and_read(tmp_path, simulator):
    made = LeggedSimulator(replace(simulator.build, friction=0.5))
    made.write(tmp_path / "simulator")
    again = read_simulator(tmp_path / "simulator")
    assert again.build == made.build
    path = tmp_path / "simulator" / "simulator.json"
    path.write_text(path.read_text().replace('"friction": 0.5', '"friction": 50'))
    with pytest.raises(FileError, match=r"simulator\.json, field 'parameters'.*friction is 50"):
        read_simulator(tmp_path / "simulator")


def test_one_of_the_version_before_is_read(tmp_path, simulator):
    simulator.write(tmp_path / "simulator")
    path = tmp_path / "simulator" / "simulator.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | {"version": 12}))
    assert read_simulator(tmp_path / "simulator").build == simulator.build
    path.write_text(json.dumps(content | {"version": 11}))
    with pytest.raises(FileError, match="reads versions 12 to 14, found 11"):
        read_simulator(tmp_path / "simulator")
