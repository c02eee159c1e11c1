"""First mistakes of users from Python: each works, or gets one clear sentence."""

import numpy as np
import pytest
import torch
from ideal_simulator import IdealWheels
from simulators_of_tests import Walker, motion_network, tables

import neurosim as ns
from neurosim.loop.check import check
from neurosim.simulators.registry import read_simulator


class Bare(ns.Simulator):
    """Classes that lack the methods of their protocols."""

    class Goal(ns.Task):
        name = "goal"

    class Still(ns.Controller):
        kind, genes = "still", 2


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "tables").mkdir()
    tables().write(tmp_path / "tables")
    return tmp_path / "tables"


GIVEN = {
    "array": np.asarray,
    "float32": lambda rows: np.asarray(rows, np.float32),
    "list": np.ndarray.tolist,
    "tensor": torch.tensor,
    "tensor of float32": lambda rows: torch.tensor(rows, dtype=torch.float32),
}


@pytest.mark.parametrize("make", [motion_network, tables, Walker, IdealWheels])
@pytest.mark.parametrize("kind", GIVEN)
def test_simulators_take_arrays_lists_and_tensors(make, kind):
    simulator, given = make(), GIVEN[kind]
    pose, command = np.array([[0.25, 0.0, 0.5], [0.0, 0.5, 0.0]]), np.array([[40.0, 20, 0.5]] * 2)
    wanted = simulator.step(simulator.start(torch.from_numpy(pose)), torch.from_numpy(command))
    state = simulator.start(given(pose))
    after = simulator.step(state, given(command))
    result = [simulator.start(given(pose)), after, simulator.over(after)]
    result += [simulator.sense(after)] if simulator.reading_names else []
    for one in result:
        assert isinstance(one, torch.Tensor if "tensor" in kind else np.ndarray)
        assert str(one.dtype).endswith("float64")
    assert np.allclose(np.asarray(after), wanted.numpy(), atol=1e-6)
    generator = torch.Generator().manual_seed(1)
    named = simulator.step(command=given(command), state=state, generator=generator)
    assert type(named) is type(after)


def test_what_is_returned_is_like_the_state():
    simulator = IdealWheels()
    state, command = simulator.start(np.zeros((1, 3))), torch.tensor([[40.0, 20.0, 0.5]])
    assert isinstance(simulator.step(state, command), np.ndarray)
    assert isinstance(simulator.step(torch.from_numpy(state), command.tolist()), torch.Tensor)
    state[:] = 1.0  # an array of one's own
    assert not np.array_equal(simulator.start(np.zeros((1, 3))), state)


def test_gradients_flow_through_steps_of_float32():
    simulator = motion_network()
    command = torch.tensor([[40.0, 20.0, 0.5]], requires_grad=True)
    simulator.step(simulator.start([[0.0, 0.0, 0.0]]), command)  # an array: no gradient
    simulator.step(simulator.start(torch.zeros(1, 3)), command)[0, 0].backward()
    assert command.grad.abs().sum() > 0


@pytest.mark.parametrize(
    ("mistake", "says"),
    [
        (lambda s: s.start([0.0, 0.0, 0.0]), r"pose must be \[B, 3\].* not of shape \[3\]"),
        (lambda s: s.step([[0.0] * 3], [[40, 20, 1]]), r"state must be \[B, 5\].*start\(pose\)"),
        (
            lambda s: s.step(s.start([[0.0] * 3]), [[40, 20]]),
            r"command must be \[B, 3\].* left, right, duration, not of shape \[1, 2\]",
        ),
        (lambda s: s.start([["here", 0, 0]]), "pose must be numbers"),
        (
            lambda s: s.start([[0.0] * 3], np.random.default_rng(0)),
            "generator must be PyTorch's: torch",
        ),
        (
            lambda s: s.start([[0.0] * 3], generator=np.random.default_rng(0)),
            "generator must be PyTorch's: torch",
        ),
    ],
)
def test_wrong_rows_and_generators_are_errors(mistake, says):
    with pytest.raises(ns.UserError, match=says):
        mistake(IdealWheels())


def test_evaluation_takes_names_as_evolution_does(folder):
    by_name = ns.evaluate(str(folder), "obstacle-avoidance", "network")
    simulator, task = read_simulator(folder), ns.make_task("obstacle-avoidance")
    itself = ns.evaluate(simulator, task, ns.make_controller("network", simulator, task))
    assert by_name.genes == itself.genes == 18
    genes = np.full((2, 18), 0.2)
    assert np.array_equal(by_name(genes), itself(genes))
    assert ns.evaluate(folder, "obstacle-avoidance").evaluator.controller.kind == "network"


@pytest.mark.parametrize(
    ("mistake", "says"),
    [
        (lambda: ns.evaluate(ns.make_task("go-to"), "go-to", "plan"), "a simulator or its folder"),
        (lambda: ns.evaluate("nowhere", "go-to", "plan"), "nowhere: no such simulator"),
        (lambda: ns.evaluate(IdealWheels(), "go-two", "plan"), "there is no task 'go-two'"),
        (lambda: ns.evaluate(IdealWheels(), "go-to", "plans"), "no kind of controller 'plans'"),
        (lambda: ns.evaluate(IdealWheels(), "go-to", 3), "a controller or its kind.* not int"),
        (lambda: ns.make_controller("network"), r"needs inputs.*make_controller\(\"network\", sim"),
        (lambda: ns.make_controller("recurrent"), "needs inputs"),
        (lambda: ns.make_controller("network", "tables"), r"give neurosim.load\('tables'\)"),
        (lambda: ns.make_controller("plan", None, "go-to"), r"neurosim.make_task\('go-to'\)"),
        (lambda: ns.evaluate(Bare(), "go-to", "plan"), "Bare has no command_names"),
        (
            lambda: ns.evaluate(IdealWheels(), Bare.Goal(), "plan")([0.5] * 40),
            r"no method worth\(\)",
        ),
        (
            lambda: ns.evaluate(IdealWheels(), "go-to", Bare.Still())([0.5] * 2),
            r"no method act\(\)",
        ),
        (lambda: ns.evaluate(IdealWheels(), "go-to", "plan")("abc"), "genes must be numbers"),
        (
            lambda: (f := ns.evaluate(IdealWheels(), "go-to", "plan"))(np.zeros((0, f.genes))),
            r"expected genes \[P, \d+\] or \[\d+\], got \(0, ",
        ),
        (lambda: IdealWheels().sense(np.zeros((1, 3))), "IdealWheels has no sensors"),
        (lambda: ns.evolve(IdealWheels(), generation=3), "no setting 'generation'; it has optim"),
        (lambda: ns.evolve(IdealWheels(), generations=0), "generations: .* found 0"),
        (lambda: ns.evolve(IdealWheels(), generations=1.5), "generations: .* found 1.5"),
        (lambda: ns.evolve(IdealWheels(), robust=3), "robust: expected RobustSettings"),
        (lambda: ns.evolve(IdealWheels(), seed="a"), "seed: expected a whole number"),
        (
            lambda: ns.make_task("go-to", goal=(1, 0, 0)),
            "go-to has no setting 'goal'; it has goals",
        ),
        (lambda: ns.make_task("go-to", goals=(1, 0, 0)), r"goals\[0\]: expected a list of 3"),
        (lambda: ns.make_task("go-to", within=float("nan")), "within: .* found nan"),
        (lambda: ns.make_controller("plan", slot=3), "plan has no setting 'slot'; it has slots"),
        (lambda: ns.make_controller("plan", durations=(3, 1)), "shortest duration, 3 s, is above"),
        (lambda: ns.rollout(IdealWheels(), [40, 20, 1]), r"commands must be \[T, C\]"),
        (lambda: ns.rollout(IdealWheels(), [[40, 20]]), "commands have 2 columns.* takes 3"),
        (lambda: ns.rollout(IdealWheels(), [[40, float("nan"), 1]]), "right = nan lies outside"),
        (lambda: ns.rollout(IdealWheels(), [[40, 20, 1]], start=(0, 0)), "start must be x"),
        (
            lambda: ns.rollout(IdealWheels(), ns.make_controller("plan")),
            "saved controller.*not Plan",
        ),
        (lambda: ns.check(ns.make_controller("plan"), IdealWheels()), "not Plan: evolve one first"),
        (lambda: ns.load(None), "expected the name of a folder, not NoneType"),
        (lambda: ns.load("."), "is not a simulator, controller or dataset: it has none of"),
        (lambda: ns.train("log.csv", "out"), "log.csv: no such dataset"),
        (lambda: ns.import_csv("log.csv", "out"), "log.csv: no such file"),
        (lambda: ns.register("tasks", "mine", Bare.Goal), "'tasks' cannot be registered; choose"),
        (lambda: ns.register("task", "go-to", Bare.Goal), "taken by neurosim's own task"),
    ],
)
def test_mistakes_get_one_sentence(mistake, says, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ns.UserError, match=says):
        mistake()


def test_anything_is_loaded_to_a_device(folder):
    assert ns.load(folder, device="cpu").kind == "tables"
    with pytest.raises(ns.UserError, match="PyTorch has no device 'gpu' on this computer; try cpu"):
        ns.load(folder, device="gpu")


@pytest.mark.slow
def test_rollouts_and_checks_take_folders_and_names(folder, tmp_path):
    simulator = read_simulator(folder)
    commands = [[20.0, 30.0, 0.5], [30.0, 20.0, 0.5]]
    poses = ns.rollout(folder, commands).poses
    assert np.array_equal(poses, ns.rollout(simulator, commands).poses)
    ns.evolve(
        folder, "obstacle-avoidance", out=tmp_path / "c", generations=1, runs=1, progress=False
    )
    saved = ns.load(tmp_path / "c")
    driven = ns.rollout(folder, tmp_path / "c", task="obstacle-avoidance").poses
    assert np.array_equal(driven, ns.rollout(simulator, saved).poses)
    assert check(saved, folder, "obstacle-avoidance", draws=4) == check(saved, folder, draws=4)
    start = np.array([0.1, 0.2, 0.3])
    for placing in ((0.0, 0.0), (0.02, 0.1)):
        placed = ns.rollout(folder, commands, start=start, samples=500, placing=placing).poses
        spread = [placing[0], placing[0], placing[1]]
        np.testing.assert_allclose((placed[:, 0] - start).std(axis=0), spread, rtol=0.15)


def test_names_are_those_that_a_user_needs():
    assert [name for name in dir(ns) if not name.startswith("_")] == ns.__all__
    assert all(hasattr(ns, name) for name in ns.__all__)
