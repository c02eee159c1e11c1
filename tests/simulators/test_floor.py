"""The floor: the fraction of motion that is lost at each position."""

import math

import numpy as np
import pytest
import torch
from motion_networks import normal, random_floor, random_motion_network

from neurosim.simulators import read_simulator
from neurosim.simulators.motion.files import write_motion
from neurosim.simulators.motion.floor import Floor, pieces

NUMBER = torch.tensor


def slope(along_x, along_y, ahead=1.0, mean=0.0):
    """Return a floor whose lost fraction grows evenly about the origin, in steps of a bell."""
    floor = Floor(torch.zeros(2, 13, 13), NUMBER([-2.4, -2.4]), 0.5, ahead)
    x, y = torch.meshgrid(*[torch.linspace(-2.4, 2.4, 13).double()] * 2, indexing="xy")
    wanted = (mean + along_x * x + along_y * y).flatten()
    centres = torch.stack([x.flatten(), y.flatten()], 1)
    weights = torch.linalg.solve(floor.bells(centres)[0], wanted).unflatten(0, (13, 13))
    return Floor(weights.expand(2, 13, 13), floor.origin, floor.length, floor.ahead)


def on(floor, pose, moved, member=-1):
    rows = [NUMBER([one], dtype=torch.float64) for one in (pose, moved)]
    return floor.moved(*rows, member)[0].tolist()


def test_an_even_loss_shortens_way_and_turn():
    # A tenth is lost everywhere: 0.3 m become 0.27 m, 0.6 rad 0.54 rad; the chord is turned back
    # by half of what the turn lost.
    dx, dy, turn = on(slope(0.0, 0.0, mean=0.1), [0.1, -0.2, 0.7], [0.3, 0.0, 0.6])
    assert turn == pytest.approx(0.54, abs=2e-4)
    assert math.hypot(dx, dy) == pytest.approx(0.27, abs=2e-4)
    assert math.atan2(dy, dx) == pytest.approx(-0.03, abs=2e-4)


@pytest.mark.parametrize(("heading", "sign"), [(0.0, 1), (math.pi, -1), (math.pi / 2, 0)])
def test_the_side_that_loses_more_falls_behind(heading, sign):
    # The loss grows by 0.05 per metre to the left of a robot that drives along x: with wheels 0.1 m
    # apart the left one travels 0.5 % less. In 0.4 m it turns by 0.02 rad to the left.
    moved = on(slope(0.0, 0.05, ahead=0.0), [0.0, 0.0, heading], [0.4, 0.0, 0.0])
    assert moved[2] == pytest.approx(sign * 0.02, abs=1e-3)
    assert moved[1] == pytest.approx(sign * 0.4 * 0.01, abs=3e-4)
    assert moved[0] == pytest.approx(0.4, abs=1e-4)


def test_backward_it_turns_the_other_way_and_sideways_too():
    floor = slope(0.0, 0.05, ahead=0.0)
    assert on(floor, [0, 0, 0], [-0.4, 0.0, 0.0])[2] == pytest.approx(-0.02, abs=1e-3)
    # An omnidirectional robot that looks along y and goes along x has the loss to its left, too.
    assert on(floor, [0, 0, math.pi / 2], [0.0, -0.4, 0.0])[2] == pytest.approx(0.02, abs=1e-3)


def test_how_much_the_way_loses_is_a_number_of_its_own():
    moved = on(slope(0.0, 0.0, ahead=0.25, mean=0.1), [0, 0, 0], [0.4, 0.0, 0.0])
    assert moved[0] == pytest.approx(0.4 * 0.975, abs=1e-4)


def test_chords_of_an_arc_add_up_to_its_displacement():
    moved = NUMBER([[0.3, 0.1, 1.2], [-0.2, 0.0, -2.9], [0.05, 0.02, 7.0]]).double()
    pose = normal(0, 3, 3)
    points, chords = pieces(pose, moved)
    cos, sin = pose[:, 2].cos(), pose[:, 2].sin()
    x, y = moved[:, 0], moved[:, 1]
    whole = torch.stack([cos * x - sin * y, sin * x + cos * y], 1)
    assert torch.allclose(chords.sum(1), whole)
    # The middle piece of a quarter circle of radius 1 from the origin: its middle is at 45 degrees.
    points, _ = pieces(torch.zeros(1, 3).double(), NUMBER([[1.0, 1.0, math.pi / 2]]).double())
    assert points[0, 1].tolist() == pytest.approx([math.sin(math.pi / 4), 0.293], abs=0.03)


def test_each_member_has_a_floor_of_its_own_and_beyond_the_map_it_goes_on():
    floor = random_floor(3, 4)
    pose, moved = normal(1, 20, 3), 0.2 * normal(2, 20, 3)
    member = torch.arange(20) % 4 - 1
    each = floor.moved(pose, moved, member)
    for number in range(-1, 3):
        own = member == number
        assert torch.equal(each[own], floor.moved(pose[own], moved[own], number))
    assert not torch.allclose(floor.moved(pose, moved, 0), floor.moved(pose, moved, 1))
    far = pose + NUMBER([1e3, 0.0, 0.0])
    assert floor.moved(far, moved).isfinite().all()


def test_a_simulator_steps_on_its_floor_and_keeps_it(tmp_path):
    simulator = random_motion_network(floor=True, noise=False)
    plain = random_motion_network(noise=False)
    pose, command = 0.3 * normal(5, 6, 3), NUMBER([[30.0, 20.0, 1.5]]).double().expand(6, 3)
    after = [one.step(one.start(pose), command)[:, :3] for one in (simulator, plain)]
    moved = plain.step(plain.start(torch.zeros(6, 3).double()), command)[:, :3]
    expected = simulator.floor.moved(pose, moved)
    cos, sin = pose[:, 2].cos(), pose[:, 2].sin()
    x = pose[:, 0] + cos * expected[:, 0] - sin * expected[:, 1]
    y = pose[:, 1] + sin * expected[:, 0] + cos * expected[:, 1]
    assert torch.allclose(after[0], torch.stack([x, y, pose[:, 2] + expected[:, 2]], 1))
    assert (after[0] - after[1]).abs().max() > 1e-3
    folder = tmp_path / "simulator"
    folder.mkdir()
    write_motion(simulator, folder)
    again = read_simulator(folder)
    assert torch.equal(again.step(again.start(pose), command)[:, :3], after[0])


def test_a_floor_must_fit():
    with pytest.raises(ValueError, match="length"):
        Floor(torch.zeros(1, 2, 2), NUMBER([0.0, 0.0]), 0.0, 1.0)
    with pytest.raises(ValueError, match="floor"):
        random_motion_network(floor=True).__class__(
            **_parts(random_motion_network(members=2), random_floor(0, 5))
        )


def _parts(simulator, floor):
    return {
        "inputs": simulator.inputs,
        "network": simulator.network,
        "genes": simulator.genes,
        "input_scale": simulator.input_scale,
        "output_scale": simulator.output_scale,
        "coordinates": simulator.coordinates,
        "central": True,
        "derived": simulator.derived,
        "drive": simulator.drive,
        "floor": floor,
    }


def test_the_map_is_the_sum_of_its_bells():
    floor = random_floor(1, 3)
    points = floor.corner + floor.cell * NUMBER([[3.0, 2.0], [5.0, 7.0]])
    bells = floor.bells(points.double())
    exact = torch.einsum("cpk,mk->mpc", bells, floor.weights.flatten(1))
    kept = torch.stack([floor.map[:, 2, 3], floor.map[:, 7, 5]], 1)
    assert torch.allclose(kept, exact)
    # The gradient is that of the value.
    step = NUMBER([[1e-5, 0.0], [0.0, 1e-5]]).double()
    for axis in (0, 1):
        more, less = (floor.bells(points.double() + s * step[axis])[0] for s in (1, -1))
        assert np.allclose((more - less) / 2e-5, bells[1 + axis], atol=1e-8)
