"""The table simulator against hand-worked numbers, and its kernel against its plain tensors."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from khepera_data import BEARINGS, BRIGHT, made_up, made_up_lights

from neurosim.base import files, se2
from neurosim.base.errors import FileError, UserError
from neurosim.base.place import Place
from neurosim.base.trajectory import Draws, Episode
from neurosim.controllers import Network
from neurosim.simulators import Simulator, TableSimulator, read_simulator
from neurosim.simulators.tables.motor_table import MotorTable
from neurosim.simulators.tables.reaction import Reaction
from neurosim.simulators.tables.simulator import RADIUS


def tensor(*rows):
    return torch.tensor(rows, dtype=torch.float64)


def standing(*poses):
    """Return states of robots that stand still."""
    return torch.tensor([[*pose, 0, 0, 0, 0] for pose in poses], dtype=torch.float64)


@pytest.fixture(scope="module")
def simulator():
    return TableSimulator(made_up(3, 0.01), noise="none")


def bay() -> Place:
    """A room with a slanted wall, a corner that points inwards, a thin wall and obstacles."""
    corners = [(0, 0), (0.6, 0), (0.7, 0.4), (0.35, 0.25), (0, 0.4)]
    return Place(corners, ((0.3, 0.05, 0.3, 0.2),), ((0.15, 0.12, 0.0275), (0.45, 0.1, 0.02)))


def test_protocol(simulator):
    assert isinstance(simulator, Simulator)
    assert simulator.command_names == ("left", "right", "duration")


def test_readings_at_samples_and_between_them(simulator):
    # The robot 20 mm from the right wall of a wide arena, turned left by 30 degrees of it.
    sim, table = simulator.changed(place=Place.rectangle(2, 2)), simulator.sensors
    at = 1 - 0.0275 - 0.020
    result = sim.sense(tensor([at, 0, 0], [at, 0, math.radians(30)], [at, 0, 2 * math.pi]))
    assert result[0].numpy() == pytest.approx(table.mean[0, 3, 0], abs=1e-6)
    assert result[1].numpy() == pytest.approx(table.mean[0, 3, 3], abs=1e-6)
    assert result[2].numpy() == pytest.approx(table.mean[0, 3, 0], abs=1e-6)
    # A quarter between two distances, and half way between the last angle and the first.
    between = sim.sense(tensor([at - 0.00125, 0, math.radians(-5)]))[0].numpy()
    corners = table.mean[0, 3:5][:, [35, 0]]
    assert between == pytest.approx(corners.mean(1).T @ [0.75, 0.25], abs=1e-6)
    # To its left the object is seen by sensors on the left: the wall at +90 degrees.
    left = sim.sense(tensor([at, 0, -math.pi / 2]))[0]
    assert left[:2].min() > 0.05 > left[3:6].max()


def test_near_far_and_beyond(simulator):
    sim, table = simulator.changed(place=Place.rectangle(2, 2)), simulator.sensors
    touching, last, half, gone = (
        sim.sense(tensor([1 - 0.0275 - d, 0, 0]))[0].numpy() for d in (0.0, 0.05, 0.0625, 0.08)
    )
    assert touching == pytest.approx(table.mean[0, 0, 0], abs=1e-6)
    assert last == pytest.approx(table.mean[0, -1, 0], abs=1e-6)
    assert half == pytest.approx((table.mean[0, -1, 0] + table.ambient) / 2, abs=1e-6)
    assert gone == pytest.approx(table.ambient, abs=1e-6)


def test_several_objects_add_up_and_saturate(simulator):
    arena = Place.rectangle(2, 2, [(0.9, 0.0, 0.0275)])
    sim, ambient = simulator.changed(place=arena), simulator.sensors.ambient
    pose = tensor([0.96, 0, 0])  # the wall 12.5 mm ahead, the obstacle 5 mm behind
    wall = simulator.changed(place=Place.rectangle(2, 2)).sense(pose)
    mean = simulator.sensors.mean
    expected = wall[0].numpy() + mean[1, 0, 18] - ambient
    assert sim.sense(pose)[0].numpy() == pytest.approx(np.clip(expected, 0, 1), abs=1e-6)
    # In a corner the sensors that look at one wall see the other, too.
    here, there = tensor([0.97, 0.97, math.pi / 8]), tensor([0.97, 0.9, math.pi / 8])
    corner, before = sim.sense(here)[0], sim.sense(there)[0]
    assert (corner[:3] > before[:3]).all()
    assert corner.max() <= 1


def test_of_a_wall_that_ends_less_is_seen(simulator):
    room = Place.rectangle(2, 2)
    board = simulator.changed(place=replace(room, walls=((0.0, -0.2, 0.0, 0.2),)))
    ambient, gap = simulator.sensors.ambient, 0.0275 + 0.01

    def light(*pose):
        return board.sense(tensor(pose))[0].numpy() - ambient

    side, end = light(-0.005 - gap, 0, 0), light(0, 0.2 + gap, -math.pi / 2)
    wall = simulator.changed(place=room).sense(tensor([1 - gap, 0, 0]))[0].numpy() - ambient
    assert side == pytest.approx(wall, abs=1e-4)
    near_end = light(-0.005 - gap, 0.2, 0)
    assert 0.05 < near_end.sum() < 0.7 * wall.sum()
    assert 0.05 < end.sum() < near_end.sum()
    # Beyond its end: the sensors on the right, where it is, see more of it.
    beyond = light(-0.005 - gap, 0.21, 0)
    assert beyond[3:6].sum() > 3 * beyond[:3].sum()
    assert light(-0.005 - gap, 0.3, 0) == pytest.approx(np.zeros(8), abs=1e-6)


def test_a_sensor_that_sees_nothing_reads_what_it_does_anywhere():
    table = made_up(3, 0.01)
    dead = replace(table, mean=np.where(np.arange(8) == 2, 0.1, table.mean))
    sim = TableSimulator(dead, noise="none", place=Place.rectangle(0.1, 0.1))
    readings = sim.sense(tensor([0.01, 0.01, 0.2]))[0]
    assert readings[2] == pytest.approx(0.1)
    assert (readings > 0.1).sum() >= 3
    still = Network(sim.reading_names)
    driven = sim.rollouts(still, Episode(0.1, 3, readings=True)).run(
        np.zeros((1, still.genes)), Draws(np.array([[0.01, 0.01, 0.2]]))
    )
    assert driven.readings[0, 0, 0] == pytest.approx(readings.numpy(), abs=1e-6)


def lit(looks, start, end, pieces=40_000):
    """Return the light [S] of a surface for sensors on the rim at the origin: of its pieces."""
    along = (end - start) / np.linalg.norm(end - start)
    # Pieces that are seen under about the same angle, however long it is.
    distance = (start - RADIUS * looks) @ along
    height = (start - RADIUS * looks) @ [along[1], -along[0]]
    total = np.zeros(len(looks))
    for s in np.flatnonzero(height > 1e-4):
        first, last = np.arctan2(
            [distance[s], distance[s] + np.linalg.norm(end - start)], height[s]
        )
        angle = first + (last - first) * (np.arange(pieces) + 0.5) / pieces
        to = height[s] / np.cos(angle)
        cos = (looks[s] @ [along[1], -along[0]]) * np.cos(angle) + (looks[s] @ along) * np.sin(
            angle
        )
        light = np.maximum(cos, 0.0) ** 2 * np.cos(angle) / to**2
        total[s] = light.sum() * (last - first) / pieces
    return total


@pytest.mark.parametrize("seed", range(20))
def test_how_far_walls_seem_to_be(simulator, seed):
    """As far as an endless wall that reflects as much light as all pieces of the walls together."""
    rng = np.random.default_rng(seed)
    walls = np.array([(-0.06, -0.07), (0.2, -0.05), (0.25, 0.09), (-0.05, 0.2)])
    outline = tuple(map(tuple, walls))
    board = (0.0, 0.0, 0.1, 0.0)
    while Place(outline, (board,)).clearance([0, 0]) < 0.029:
        board = tuple(rng.uniform(-0.05, 0.1, 4).tolist())
    arena = Place(outline, (board,))
    sim = simulator.changed(place=arena)
    state = tensor([0, 0, rng.uniform(-3, 3)])
    to, _, _ = sim._objects(state)
    reach = 0.0825 + 0.0275  # beyond it no light counts
    seen = (~sim._hidden(state, to))[0].numpy() & (to[0].norm(dim=-1).numpy() < reach)
    angles = sim.bearings + state[0, 2].item()
    looks = np.stack([np.cos(angles), np.sin(angles)], 1)
    light = np.zeros((len(arena.surfaces), len(looks)))
    for w in np.flatnonzero(seen):
        start, end = arena.surfaces[w].reshape(2, 2)
        if start @ [end[1] - start[1], start[0] - end[0]] > 0:  # else it is its back
            light[w] = lit(looks, start, end)
    distance, bearing, kind = (each.numpy() for each in sim._seen(state))
    assert kind.tolist() == [0]
    for s in np.flatnonzero(light.sum(0)):
        nearest = to[0, light[:, s].argmax()].numpy()
        away = np.linalg.norm(nearest)
        assert math.cos(bearing[0, 0, s] + state[0, 2]) == pytest.approx(nearest[0] / away)
        # The endless wall at its position, and at its apparent distance.
        normal = nearest / away
        further = nearest + (distance[0, 0, s] - (away - RADIUS)) * normal
        aside = 1000 * np.array([-normal[1], normal[0]])
        endless = lit(looks, further - aside, further + aside)
        if math.isfinite(distance[0, 0, s]) and distance[0, 0, s] > 0:
            assert endless[s] == pytest.approx(light[:, s].sum(), rel=2e-3)


def test_a_wall_hides_what_is_behind_it(simulator):
    # A thin wall ahead, the obstacle right behind it: nothing of the obstacle is seen.
    thin = Place(Place.rectangle(2, 2).outline, ((0.02, -0.5, 0.02, 0.5),))
    with_obstacle = Place(thin.outline, thin.walls, ((0.04, 0.0, 0.01),))
    pose = tensor([-0.02, 0, 0], [-0.02, 0.01, 0.3])
    without, behind = (simulator.changed(place=a).sense(pose) for a in (thin, with_obstacle))
    assert torch.equal(without, behind)
    neighbour = simulator.changed(place=with_obstacle).sense(tensor([0.09, 0, math.pi]))
    assert neighbour[0, 2] > 0.05


def test_motion(simulator):
    sim = simulator.changed(place=Place.rectangle(4, 4))
    result = sim.step(
        standing([0, 0, 0], [0, 0, math.pi / 2], [0, 0, 0], [0, 0, 0]),
        tensor([100, 100, 1], [50, 50, 2], [-30, 30, 0.5], [44, 44, 1]),
    )
    assert result[0, :3].tolist() == pytest.approx([0.1, 0, 0])
    assert result[1, :3].tolist() == pytest.approx([0, 0.1, math.pi / 2])
    assert result[2, :3].tolist() == pytest.approx([0, 0, 0.06 / 0.053 * 0.5])
    assert result[3, 0] == pytest.approx(0.04)  # 44 % is 4 of the robot's 10 units


def test_collisions(simulator):
    sim = simulator.changed(place=Place.rectangle(1, 1, [(0, 0, 0.05)]))
    result = sim.step(
        standing([0.4, 0.2, 0], [0.4, 0.2, math.pi / 4], [-0.1, 0, 0], [0.4, 0.2, 0]),
        tensor([100, 100, 3], [100, 100, 2], [100, 100, 1], [100, -100, 1]),
    )
    assert result[0, 0] == pytest.approx(0.5 - 0.0275)
    assert result[1, :2].tolist() == pytest.approx([0.4725, 0.2 + 0.2 * math.sqrt(0.5)], abs=1e-9)
    assert result[2, 0] == pytest.approx(-0.0775)
    assert result[3, :3].tolist() == pytest.approx([0.4, 0.2, -0.2 / 0.053])


def test_a_gap_that_is_too_narrow_holds_the_robot(simulator):
    gap = Place(Place.rectangle(1, 1).outline, ((0, 0.027, 0, 0.5), (0, -0.5, 0, -0.027)))
    result = simulator.changed(place=gap).step(standing([-0.1, 0, 0]), tensor([100, 100, 3]))
    assert -0.03 < result[0, 0] < 0
    wider = Place(gap.outline, ((0, 0.028, 0, 0.5), (0, -0.5, 0, -0.028)))
    result = simulator.changed(place=wider).step(standing([-0.1, 0, 0]), tensor([100, 100, 3]))
    assert result[0, 0] == pytest.approx(0.2)


def test_a_late_robot(simulator):
    """Hand-worked: nothing for 60 ms, then wheels that approach 100 mm/s with lags of 50 ms."""
    reaction = Reaction(0.04, 0.02, (0.05, 0.05))
    sim = simulator.changed(place=Place.rectangle(4, 4), reaction=reaction)
    state, command = standing([0, 0, 0]), tensor([100, 100, 0.1])
    state = sim.step(state, command)
    gone = 0.1 * (0.04 - 0.05 * (1 - math.exp(-0.8)))
    speed = 100 * (1 - math.exp(-0.8))
    assert state[0].tolist() == pytest.approx([gone, 0, 0, speed, speed, 100, 100])
    # Stopped; for 60 ms the robot does not react.
    state = sim.step(state, tensor([0, 0, 0.1]))
    gone += 0.1 * (0.06 - 0.05 * math.exp(-0.8) * (1 - math.exp(-1.2)))
    speed = 100 * (1 - math.exp(-2.0))
    gone += speed / 1000 * 0.05 * (1 - math.exp(-0.8))
    assert state[0, :3].tolist() == pytest.approx([gone, 0, 0])
    assert state[0, 5:].tolist() == [0, 0]
    # A long command equals many short ones; unequal wheels turn the robot at the start.
    uneven = sim.changed(reaction=Reaction(0.04, 0.02, (0.03, 0.08)))
    long = uneven.step(standing([0, 0, 0]), tensor([60, 60, 1.0]))
    short = standing([0, 0, 0])
    for _ in range(10):
        short = uneven.step(short, tensor([60, 60, 0.1]))
    assert long[0].tolist() == pytest.approx(short[0].tolist(), abs=1e-4)
    assert long[0, 2].item() == pytest.approx(0.06 * (0.03 - 0.08) / 0.053, rel=1e-3)


def test_no_such_reaction():
    with pytest.raises(UserError, match="hold: expected a number from 0 to 1, found -0"):
        Reaction(-0.1)
    with pytest.raises(UserError, match=r"lag\[1\]: expected a number from 0 to 1, found nan"):
        Reaction(lag=(0.0, math.nan))


def driven(sim, genes, starts, seeds, steps, duration):
    drives = sim.rollouts(Network(sim.reading_names), Episode(duration, steps))
    noise = None if seeds is None else sim.noise_of(seeds, steps)
    result = drives.run(genes, Draws(starts, noise=noise))
    return result.poses, result.readings, result.commands


@pytest.mark.parametrize("reaction", [Reaction(), Reaction(0.03, 0.04, (0.03, 0.06))])
@pytest.mark.parametrize("arena", [Place.rectangle(0.6, 0.35, [(0.1, 0, 0.0275)]), bay()])
@pytest.mark.slow
def test_kernel_is_the_tensors(simulator, arena, reaction):
    rng = np.random.default_rng(3)
    sim = simulator.changed(place=arena, reaction=reaction)
    genes = rng.normal(0, 1.5, (12, 18)) + np.tile([0] * 8 + [1], 2)
    starts = arena.free_poses(4, sim.radius, rng)
    poses, readings, commands = driven(sim, genes, starts, None, 60, 0.35)
    before = torch.from_numpy(poses[:, :, :-1].reshape(-1, 3))
    assert np.abs(sim.sense(before).numpy() - readings.reshape(-1, 8)).max() < 1e-5
    sums = readings @ genes.reshape(12, 2, 9)[:, None, :, :8].swapaxes(-1, -2)
    given = 100 * np.tanh(sums + genes.reshape(12, 2, 9)[:, None, None, :, 8])
    assert np.abs(given - commands).max() < 1e-3
    state = sim.start(torch.from_numpy(poses[:, :, 0].reshape(-1, 3)))
    for step in range(60):
        command = torch.from_numpy(commands[:, :, step].reshape(-1, 2)).double()
        state = sim.step(state, torch.nn.functional.pad(command, (0, 1), value=0.35))
        assert np.abs(state[:, :3].numpy() - poses[:, :, step + 1].reshape(-1, 3)).max() < 1e-9
    assert readings.max() > 0.8  # they met something
    assert arena.clearance(poses[..., :2]).min() > 0.0275 - 2e-4


@pytest.mark.slow
@pytest.mark.parametrize("noise", ["uniform", "samples"])
def test_noise_is_as_wide_as_it_says(simulator, noise):
    motors = MotorTable.ideal()
    spread = np.full_like(motors.twist, 0.002)
    motors = MotorTable(motors.levels, motors.twist, spread, motors.resolution)
    sim = simulator.changed(noise=noise, motors=motors, place=Place.rectangle(2, 2))
    pose = tensor([0.955, 0.1, 0.2]).expand(20_000, 3)
    generator = torch.Generator().manual_seed(0)
    mean, sampled = sim.sense(pose), sim.sense(pose, generator)
    command = tensor([50, 30, 0.1]).expand(20_000, 3)
    moved = sim.step(sim.start(pose), command, generator)
    genes = np.zeros((1, 18))
    genes[0, [8, 17]] = np.arctanh([0.5, 0.3])
    starts, seeds = pose.numpy(), np.arange(20_000).astype(np.uint64) * 7919
    poses, readings, _ = driven(sim, genes, starts, seeds, 1, 0.1)
    for values in (sampled.numpy(), readings[0, :, 0]):
        off = (values - mean.numpy())[:, 2:4]
        assert np.abs(off.mean(0)).max() < 0.002
        if noise == "uniform":
            assert off.std(0) == pytest.approx(0.05 / math.sqrt(3), rel=0.03)
            assert np.abs(off).max() <= 0.05 + 1e-6
        else:
            assert off.std(0) == pytest.approx(0.01, rel=0.7)  # of three repeats
    straight = moved.numpy()[:, 2] - 0.2
    compiled = poses[0, :, 1, 2] - 0.2
    turn = 0.05 * (0.2 / 0.053) * 0.1 / math.sqrt(3) if noise == "uniform" else 0.002 * 0.1**0.5
    for values in (straight, compiled):
        assert values.std() == pytest.approx(turn, rel=0.03)
        assert values.mean() == pytest.approx(-0.02 / 0.053 * 0.1, rel=0.02)
    assert sampled.std(0)[2:4].numpy() == pytest.approx(readings[0, :, 0].std(0)[2:4], rel=0.05)


def test_same_seed_same_numbers(simulator):
    sim = simulator.changed(noise="uniform")
    pose, command = standing([0.2, 0.1, 0.0]), tensor([50, 60, 0.1])
    one, two = (sim.step(pose, command, torch.Generator().manual_seed(4)) for _ in range(2))
    assert torch.equal(one, two)
    assert torch.equal(sim.step(pose, command), sim.step(pose, command))


def test_noise_of_samples_needs_repeats():
    with pytest.raises(UserError, match="needs repeated samples"):
        TableSimulator(made_up(), noise="samples")
    with pytest.raises(UserError, match="noise is one of none, uniform, samples"):
        TableSimulator(made_up(), noise="loud")


def test_folder(simulator, tmp_path):
    late = Reaction(0.03, 0.01, (0.05, 0.04))
    simulator.changed(place=bay(), noise="samples", reaction=late).write(tmp_path)
    read = read_simulator(tmp_path)
    assert read.reaction == late
    pose = torch.from_numpy(bay().free_poses(20, 0.0275, np.random.default_rng(0)))
    assert torch.equal(read.sense(pose), simulator.changed(place=bay()).sense(pose))
    assert (read.place, read.noise, read.motors.resolution) == (bay(), "samples", 10.0)
    document = json.loads((tmp_path / "simulator.json").read_text())
    for change, message in (
        ({"radius": -1}, "field 'radius'"),
        ({"radius": 1e-300}, "field 'radius'"),
        ({"noise": {"kind": "loud", "level": 0.05}}, "noise.kind.*one of .none"),
        ({"place": {"outline": [[0, 0], [1, 1]]}}, "at least 3 corners"),
        ({"sensors": {}}, "sensors.objects"),
    ):
        (tmp_path / "simulator.json").write_text(json.dumps(document | change))
        with pytest.raises(FileError, match=message):
            read_simulator(tmp_path)


def test_motor_table_of_samples(tmp_path):
    rng = np.random.default_rng(0)
    rows = [
        (left, right, 0.5, *se2.exp(0.5 * np.array([left + 2 * right, 0, right - left]) / 1000))
        for left in (-100, 0, 100)
        for right in (-100, 0, 100)
        for _ in range(2)
    ]
    table = np.array(rows)
    motors = MotorTable.from_samples(*table[:, :3].T, table[:, 3:])
    assert motors.twist[2, 1] == pytest.approx([0.1, 0, -0.1])
    assert motors.spread == pytest.approx(np.zeros((3, 3, 3)), abs=1e-9)
    noisy = np.repeat(table, 500, axis=0)
    noisy[:, 5] += 0.01 * rng.standard_normal(len(noisy))
    spread = MotorTable.from_samples(*noisy[:, :3].T, noisy[:, 3:]).spread
    assert spread[..., 2] == pytest.approx(0.01 / math.sqrt(0.5), rel=0.1)
    with pytest.raises(UserError, match=r"1 holes, the first at left -100 %, right 0 %"):
        holed = np.delete(table, [2, 3], 0)
        MotorTable.from_samples(*holed[:, :3].T, holed[:, 3:])
    racing = table[:, 3:] * [1e9, 1, 1]
    with pytest.raises(UserError, match=r"a speed of .* the limit is"):
        MotorTable.from_samples(*table[:, :3].T, racing)
    text = "left,right,duration,dx,dy,dtheta\n"
    (tmp_path / "motors.csv").write_text(
        text + "".join(",".join(map(str, row)) + "\n" for row in rows)
    )
    assert MotorTable.read_csv(tmp_path / "motors.csv").twist == pytest.approx(motors.twist)
    for rows, message in (("", "has no rows"), ("0,0,-1,0,0,0\n", "line 2, field 'duration'")):
        (tmp_path / "motors.csv").write_text(text + rows)
        with pytest.raises(FileError, match=message):
            MotorTable.read_csv(tmp_path / "motors.csv")
    (tmp_path / "motors.csv").write_text(text + "0,0,1,0,0,0\n50,50,1,0,0,0\n80,80,1,0,0,0\n")
    with pytest.raises(FileError, match="0 and 50 % are 50 apart, 50 and 80 % are 30"):
        MotorTable.read_csv(tmp_path / "motors.csv")


def test_a_start_in_something_solid_is_no_start(simulator):
    arena = replace(simulator.place, start=(0.03, 0.0, 0.0), obstacles=((0.0, 0.0, 0.02),))
    with pytest.raises(UserError, match="would stand in a wall or an obstacle"):
        simulator.changed(place=arena)


def test_where_its_sensors_look_is_in_its_tables():
    simulator = TableSimulator(made_up())
    assert simulator.bearings == pytest.approx(BEARINGS, abs=1e-6)
    open_loop = simulator.sensors.mean.copy()
    open_loop[..., 3] = 0.25
    simulator = TableSimulator(replace(simulator.sensors, mean=open_loop))
    assert np.isnan(simulator.bearings[3])
    assert np.isfinite(np.delete(simulator.bearings, 3)).all()


def test_a_picture_shows_walls_and_obstacles():
    arena = Place(Place.rectangle(2, 2).outline, ((0.0, -0.5, 0.0, 0.5),), ((0.4, 0.0, 0.1),))
    assert TableSimulator(made_up(), place=arena).outline() == [
        {"polygon": [[-1, -1], [1, -1], [1, 1], [-1, 1]]},
        {
            "polygon": [[-0.005, -0.5], [-0.005, 0.5], [0.005, 0.5], [0.005, -0.5]],
            "forbidden": True,
        },
        {"circle": [0.4, 0, 0.1], "forbidden": True},
    ]


def test_tables_of_another_precision_are_read_as_their_own(tmp_path):
    from simulators_of_tests import tables

    tables().write(tmp_path)
    path = tmp_path / "tables.safetensors"
    files.write_tensors(
        path, {name: each.astype(np.float32) for name, each in files.read_tensors(path).items()}
    )
    read = TableSimulator.read(tmp_path)
    assert read.motors.twist.dtype == read.sensors.mean.dtype == np.float64


@pytest.fixture(scope="module")
def seeing():
    """A simulator with three kinds of objects near the robot, a light, and the noise of repeats."""
    near = made_up(3, 0.01, bright={**BRIGHT, "cylinder-12.5mm": 0.2})
    return TableSimulator(near, lights=made_up_lights(3, 0.01), noise="none")


def test_an_obstacle_looks_like_the_sampled_one_of_its_size(seeing):
    def read(radius):
        """Readings 20 mm before an obstacle."""
        obstacle = (0.0275 + 0.02 + radius, 0.0, radius)
        arena = Place.rectangle(2, 2, [obstacle])
        sim = seeing.changed(place=arena, senses=("proximity",))
        return sim.sense(tensor([0, 0, 0]))[0].numpy(), sim.notes

    mean = seeing.sensors.mean
    assert seeing.sensors.kinds == ("wall", "cylinder-12.5mm", "cylinder")
    assert (mean[2, 3, 0, 2] - 0.02) / (mean[1, 3, 0, 2] - 0.02) > 1.5
    for radius, kind, size in ((0.0125, 1, ""), (0.0275, 2, ""), (0.019, 1, 12.5), (0.05, 2, 27.5)):
        readings, notes = read(radius)
        assert readings == pytest.approx(mean[kind, 3, 0], abs=1e-6)
        text = f"obstacles of {1000 * radius:g} mm radius were not sampled: they look like those of"
        assert notes == ((f"{text} {size} mm",) if size else ())


def test_a_light_is_looked_up_by_distance_and_bearing(seeing):
    def read(pose, *lights, **place):
        arena = replace(Place.rectangle(4, 4), lights=lights, **place)
        sim = seeing.changed(place=arena, senses=("light",))
        assert sim.reading_names == tuple(f"light_{index}" for index in range(8))
        return sim.sense(tensor(pose))[0].numpy()

    mean, dark = seeing.lights.mean[0], seeing.lights.ambient
    ahead = (0.0275 + 0.045, 0.0)  # the third distance
    assert read((0, 0, 0), ahead) == pytest.approx(mean[2, 0], abs=1e-6)
    # Turned to the left by 30 degrees, the light is 30 degrees to the right; from another place.
    assert read((0, 0, math.pi / 6), ahead) == pytest.approx(mean[2, 3], abs=1e-6)
    turned = read((1.0, -0.5, math.pi / 2), (1.0, ahead[0] - 0.5))
    assert turned == pytest.approx(mean[2, 0], abs=1e-6)
    # A quarter between two distances; above the light the first one counts.
    between = read((0, 0, 0), (ahead[0] + 0.005, 0.0))
    assert between == pytest.approx(0.75 * mean[2, 0] + 0.25 * mean[3, 0], abs=1e-6)
    assert read((0, 0, 0), (0.001, 0.0)) == pytest.approx(mean[0, 0], abs=1e-6)
    # Two of them add up above the dark; one out of reach, and none, leave it dark.
    both = read((0, 0, 0), ahead, (0.0, ahead[0]))
    expected = np.clip(mean[2, 0] + mean[2, 27] - dark, 0.0, 1.0)
    assert both == pytest.approx(expected, abs=1e-6)
    for lights in ((), ((1.5, 0.0),)):
        assert read((0, 0, 0), *lights) == pytest.approx(dark, abs=1e-6)


def test_walls_and_obstacles_shade_a_light(seeing):
    light = (0.15, 0.0)

    def lit(y=0.0, **place):
        arena = replace(Place.rectangle(2, 2), lights=(light,), **place)
        sim = seeing.changed(place=arena, senses=("light",))
        reading = sim.sense(tensor([0, y, 0]))[0].numpy()
        return bool(np.abs(reading - sim.lights.ambient).max() > 0.01)

    wall, cylinder = (0.08, -0.05, 0.08, 0.03), (0.08, 0.02, 0.0125)
    assert lit()
    assert not lit(walls=(wall,))
    assert lit(0.1, walls=(wall,))  # past its end
    # The line to the light passes 20 mm from its middle, and then, further to the left, 6 mm.
    assert lit(obstacles=(cylinder,))
    assert not lit(0.03, obstacles=(cylinder,))
    behind = (0.2, 0.0, 0.0125), (-0.06, 0.0, 0.0125)
    assert lit(obstacles=behind)


@pytest.mark.parametrize("noise", ["none", "uniform", "samples"])
@pytest.mark.parametrize("senses", [("proximity",), ("light",), ("proximity", "light")])
def test_kernels_sense_what_the_tensors_do(seeing, senses, noise):
    """At random poses among walls, obstacles of two sizes and two lights, with the same noise."""
    room = bay()
    small = (0.55, 0.2, 0.0125)
    arena = replace(
        room, obstacles=(*room.obstacles, small), lights=((0.1, 0.3), (0.5, 0.05), (0.62, 0.3))
    )
    sim = seeing.changed(place=arena, noise=noise, senses=senses)
    count = len(sim.reading_names)
    assert count == 8 * len(senses)
    assert sim.noise_width == count + 3
    starts = arena.free_poses(300, sim.radius, np.random.default_rng(5))
    z = np.random.default_rng(6).uniform(-1, 1, (300, 1, sim.noise_width)).astype(np.float32)
    z = None if noise == "none" else z
    genes = np.zeros((1, 2 * (count + 1)))
    driven = sim.rollouts(Network(sim.reading_names), Episode(0.1, 1)).run(
        genes, Draws(starts, noise=z)
    )
    given = None if z is None else torch.from_numpy(z[:, 0]).double()
    expected = sim.sense(torch.from_numpy(starts), z=given).numpy()
    assert driven.readings[0, :, 0] == pytest.approx(expected, abs=1e-5)
    assert expected.std(axis=0).min() > 0.01


def test_a_folder_keeps_kinds_and_lights(seeing, tmp_path):
    arena = replace(bay(), lights=((0.5, 0.05),))
    seeing.changed(place=arena).write(tmp_path)
    read = read_simulator(tmp_path)
    assert read.reading_names == seeing.reading_names
    assert (read.sensors.kinds, read.lights.kinds) == (seeing.sensors.kinds, ("light",))
    pose = torch.from_numpy(arena.free_poses(20, 0.0275, np.random.default_rng(0)))
    assert torch.equal(read.sense(pose), seeing.changed(place=arena).sense(pose))
    document = json.loads((tmp_path / "simulator.json").read_text())
    for name, objects in (
        ("sensors", ["wall", "cylinder-12.5mm", "ball"]),
        ("sensors", ["cylinder", "wall", "cylinder-30mm"]),
        ("lights", ["wall"]),
    ):
        changed = {**document, name: {**document[name], "objects": objects}}
        (tmp_path / "simulator.json").write_text(json.dumps(changed))
        with pytest.raises(FileError, match=r"objects|expected a wall and cylinders"):
            read_simulator(tmp_path)


def test_light_needs_a_table_of_it(simulator):
    with pytest.raises(UserError, match=r"no readings of light: sample a light, too .*--light"):
        simulator.changed(senses=("light",))
    assert simulator.reading_names == tuple(f"sensor_{index}" for index in range(8))
