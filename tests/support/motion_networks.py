"""Random motion networks of every form, with small numbers so that motions stay moderate."""

import torch

from neurosim.networks import ProductSummationNetwork
from neurosim.simulators import MotionNetwork
from neurosim.simulators.motion.derived import Derived
from neurosim.simulators.motion.drive import DriveModel
from neurosim.simulators.motion.floor import Floor
from neurosim.simulators.motion.kernel_units import KernelUnits
from neurosim.simulators.motion.noise import CommandFeatures, NoiseModel

NAMES = ("prev_left", "prev_right", "left", "right", "duration")
#: The longest command, s, and the largest speed.
LONGEST, FASTEST = 3.0, 50.0


def normal(seed, *shape):
    """Return numbers of a standard normal distribution."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def noise_model(seed=0, size=-4.0, moved=True):
    """Return a noise model of about e^size metres and radians.

    If ``moved``, its size also depends on the motion.
    """
    sampled = {
        name: 0.2 * normal(seed + n, *shape)
        for n, (name, shape) in enumerate(NoiseModel.SHAPES.items())
    }
    last = sampled["log_scale"][:, -1:] if moved else torch.zeros(3, 1)
    sampled["log_scale"] = torch.cat([0.2 * normal(seed + 1, 3, 5), last], dim=1)
    sampled["unit"] = torch.tensor([1.0, 0.2, 0.1])
    sampled["log_scale"][:, 0] += size
    sampled["sources"] *= 0.1
    return NoiseModel(**sampled)


def drive_model(seed=0, actuators=2, curved=True, **parts):
    """Return a drive model of a robot of about 0.3 m/s and 2 rad/s; that of an odd seed drifts.

    If not ``curved``, a single number says how much speeds fall short of proportional ones.
    """
    shapes = DriveModel.shapes(actuators)
    names = "lag", "slowing", "braking", "rate", "curve", "stick", "delay", "kinematics"
    sampled = {name: torch.tanh(normal(seed + k, *shapes[name])) for k, name in enumerate(names)}
    straight = torch.zeros(shapes["curve"], dtype=torch.float64)
    straight[:, 0] = -0.15 * torch.tanh(normal(seed + 4, actuators))
    result = {
        "lag": 0.12 + 0.08 * sampled["lag"],
        "slowing": 1.0 + 0.4 * sampled["slowing"],
        "braking": 0.8 + 0.4 * sampled["braking"],
        "rate": 5.0 + 3.0 * sampled["rate"],
        "stick": 0.02 + 0.02 * sampled["stick"],
        "curve": 0.1 * sampled["curve"] if curved else straight,
        "delay": 0.05 + 0.04 * sampled["delay"],
        "kinematics": torch.tensor([0.15, 0.05, 1.0]) * sampled["kinematics"],
        "drift": torch.tensor([0.2, 0.3], dtype=torch.float64) * (seed % 2),
        "modes": torch.eye(actuators) + 0.3 * torch.tanh(normal(seed + 8, *shapes["modes"])),
    }
    return DriveModel(**(result | parts))


def kernel_units(seed, count, inputs, networks):
    """Return kernel units near typical inputs, with small weights in each of the networks."""
    return KernelUnits(
        0.5 * normal(seed, count, inputs),
        0.6 + normal(seed + 1, inputs).abs(),
        0.02 * normal(seed + 2, networks, 3, count),
    )


def random_floor(seed, networks):
    """Return a floor of 2 m by 1.5 m that takes up to about a tenth of the motion."""
    weights = 0.05 * normal(seed, networks, 5, 6)
    number = torch.tensor
    return Floor(weights, number([-1.0, -0.8]), 0.5, 0.7)


def random_motion_network(
    seed=0,
    *,
    names=NAMES,
    members=3,
    central=True,
    drives=True,
    units=6,
    swing=0.03,
    noise=True,
    products=4,
    summations=1,
    size=0.05,
    scale=None,
    meta=None,
    floor=False,
    excess=None,
):
    """Return an ensemble of random networks, of unequally many units.

    Args:
        seed: of all numbers.
        names: of the inputs.
        members: how many there are.
        central: whether the mean is a network of its own.
        drives: whether there is a drive model; or the model.
        units: how many kernel units.
        swing: of :class:`Derived`.
        noise: whether there is a noise model; or the model.
        products: of each network.
        summations: of each network.
        size: scale of the networks' outputs, m and rad.
        scale: scale of each input.
        meta: other keys of simulator.json.
        floor: whether there is a floor.
        excess: of :class:`Excess`, or None.
    """
    derived, count = Derived(swing), members + central
    inputs = len(names) + len(derived)
    network = ProductSummationNetwork(inputs, products, summations)
    genes = 2.0 / inputs * normal(seed, count, 3, network.genes)
    weights = network.split(genes)
    weights.exponents.abs_()  # so that no unit is large where an input is small
    weights.product_weights[0, 0, :2] = weights.product_weights[-1, 2] = 0.0  # left out
    model = noise_model(seed) if noise is True else noise or None
    if scale is None:
        scale = [LONGEST if name == "duration" else FASTEST for name in names]
    actuators = len(CommandFeatures.of(tuple(names)).driven)
    return MotionNetwork(
        [{"name": name, "unit": "s" if name == "duration" else "%"} for name in names],
        network,
        genes,
        torch.tensor(scale),
        torch.full((3,), size),
        "residual-twist" if drives else "displacement",
        meta,
        noise=model,
        dead_band=torch.tensor([0.05 * (name != "duration") for name in names]),
        central=central,
        derived=derived,
        drive=drive_model(seed, actuators) if drives is True else drives or None,
        kernel_units=kernel_units(seed, units, inputs, count) if units else None,
        floor=random_floor(seed, 1 + members) if floor else None,
        excess=excess,
    )
