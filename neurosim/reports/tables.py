"""Simulators of tables and networks: what was sampled, Figures 3 and 4 of Lund and Miglino 1996."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from neurosim.base.errors import FileError, UserError
from neurosim.reports.arena import draw_objects
from neurosim.reports.artefacts import Artefact, Artefacts
from neurosim.reports.charts import ragged
from neurosim.reports.page import Block, Picture, Row, Section, Table
from neurosim.reports.svg import INK, drawing, to_svg
from neurosim.simulators import TableSimulator
from neurosim.simulators.tables.arena import Arena
from neurosim.simulators.tables.sensor_table import OBJECTS

#: Readings at which a sensor's picture gets darker.
LEVELS = (0.1, 0.3, 0.5, 0.7, 0.9)
#: More trajectories than this are drawn no longer one by one.
MOST_DRAWN = 12


def samples(artefacts: Artefacts) -> Section | None:
    """Write the section on what the robot sampled; None without simulators of tables."""
    blocks: list[Block] = []
    for place, (artefact, simulator) in enumerate(artefacts.tables):
        blocks += [_sensors(artefact.name, simulator, f"t{place}"), _summary(simulator)]
        blocks.append(_motors(artefact.name, simulator))
    return Section("samples", "What the robot sampled", blocks) if blocks else None


def networks(artefacts: Artefacts) -> Section | None:
    """Write the section on evolved networks; None without any."""
    if not artefacts.networks:
        return None
    rows = [
        [
            one.name,
            f"{one.meta['predicted']['fitness']:.1f}",
            f"{one.meta['predicted'].get('spread', 0.0):.1f}",
            str(len(history(one)["best"])),
            _before_and_after(one),
        ]
        for one in artefacts.networks
    ]
    head = [
        "network", "fitness in the simulator", "spread of a trial", "generations",
        "mean at transfer, at the end",
    ]  # fmt: skip
    blocks: list[Block] = [
        Table("Networks, and what the simulator says of them", head, rows),
        _evolution(artefacts.networks),
    ]
    driven = [(one, drives) for one in artefacts.networks if (drives := trajectories(one))]
    blocks += [
        Row([_trajectories(one, f"tj{n}-{k}", k, drive) for k, drive in enumerate(drives)])
        for n, (one, drives) in enumerate(driven[:MOST_DRAWN])
    ]
    return Section("networks", "The evolved networks", blocks)


def verdict(artefacts: Artefacts) -> str:
    """Say what came of the networks, in a sentence or two."""
    fitness = [one.meta["predicted"]["fitness"] for one in artefacts.networks]
    most = {_most(one) for one in artefacts.networks}
    of = f" of at most {most.pop()}" if len(most) == 1 and None not in most else ""
    text = f"The network reaches a fitness of {np.mean(fitness):.0f}{of} in the simulator."
    if len(fitness) > 1:
        text = (
            f"{len(fitness)} networks reach a fitness of {np.mean(fitness):.0f}{of} in the "
            f"simulator on average ({min(fitness):.0f} to {max(fitness):.0f})."
        )
    changes = [
        change for one in artefacts.networks if (change := change_at_transfer(one)) is not None
    ]
    if changes:
        text += (
            " At the transfer to the robot the best of the population changed by "
            f"{100 * np.mean(changes):+.1f} % of its fitness{' on average' * (len(changes) > 1)}, "
            "in single trials of generations that follow each other."
        )
    drives = [drive for one in artefacts.networks for drive in trajectories(one)]
    if drives:
        apart = np.median([_apart(drive) for drive in drives])
        text += f" From the same start its path there is {100 * apart:.1f} cm off (median)."
    return text


def history(network: Artefact) -> dict[str, Any]:
    """Return ``best`` and ``mean`` of every generation, and ``transfer`` where there was one.

    ``transfer`` is the number of generations before the robot took the simulator's place.

    Raises:
        FileError: if the controller's history is not that.
    """
    found = network.meta["evolution"].get("history")
    try:
        best, mean = (np.array(found[name], float) for name in ("best", "mean"))
        transfer = found.get("transfer")
        whole = best.shape == mean.shape == (len(best),) and len(best) > 0
        if not whole or not (transfer is None or 0 < int(transfer) <= len(best)):
            raise ValueError
    except (AttributeError, KeyError, TypeError, ValueError):
        raise FileError(
            network.json, "expected best and mean of every generation", field="evolution.history"
        ) from None
    return {"best": best, "mean": mean, "transfer": transfer}


def trajectories(network: Artefact) -> list[dict[str, NDArray[np.float64]]]:
    """Return drives from the same starts, {"simulated", "robot"}: poses [T + 1, 3] each.

    Raises:
        FileError: if what the controller holds is not that.
    """
    found = network.meta["evolution"].get("trajectories") or []
    try:
        drives = [
            {name: np.array(drive[name], float) for name in ("simulated", "robot")}
            for drive in found
        ]
        if any(path.ndim != 2 or path.shape[1] != 3 for one in drives for path in one.values()):
            raise ValueError
    except (KeyError, TypeError, ValueError):
        raise FileError(
            network.json, "expected poses [x, y, theta]", field="evolution.trajectories"
        ) from None
    return drives


def change_at_transfer(network: Artefact) -> float | None:
    """Return the change of the population's best from simulator to robot, as a share of it."""
    lines = history(network)
    transfer, best = lines["transfer"], lines["best"]
    if transfer is None or transfer >= len(best) or best[transfer - 1] == 0:
        return None
    return float(best[transfer] / best[transfer - 1] - 1.0)


def _most(network: Artefact) -> int | None:
    """Return the highest fitness there is: a step of equation (1) is worth at most 1."""
    settings = network.meta["task"].get("settings", {})
    return settings.get("steps") if settings.get("fitness", "avoidance") == "avoidance" else None


def _before_and_after(network: Artefact) -> str:
    lines = history(network)
    if lines["transfer"] is None:
        return f"no transfer, {lines['mean'][-1]:.1f}"
    return f"{lines['mean'][lines['transfer'] - 1]:.1f}, {lines['mean'][-1]:.1f}"


def _evolution(found: Sequence[Artefact]) -> Picture:
    every = [history(one) for one in found]
    transfers = sorted({one["transfer"] for one in every if one["transfer"] is not None})
    with drawing(6.2, 3.2) as (figure, axes):
        for name, label, ink in (("best", "peak", "predicted"), ("mean", "mean", "third")):
            table = ragged([one[name] for one in every])
            number = np.arange(1, table.shape[1] + 1)
            for row in table if len(table) > 1 else ():
                axes.plot(number, row, color=INK[ink], lw=0.6, alpha=0.3)
            axes.plot(
                number, np.nanmean(table, axis=0), color=INK[ink], lw=1.8, label=label,
                marker="o" if len(number) == 1 else None,
            )  # fmt: skip
        for place, transfer in enumerate(transfers):
            axes.axvline(
                transfer + 0.5, color=INK["actual"], ls="--", lw=1.2,
                label=None if place else "onto the robot",
            )  # fmt: skip
        axes.set_xlabel("generation")
        axes.set_ylabel("fitness")
        axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=3, borderaxespad=0)
        label = "Fitness of the population's best and its mean over generations"
        svg = to_svg(figure, label, "n")
    runs = "" if len(found) == 1 else f", average of {len(found)} runs (each one thin)"
    after = f"; from generation {transfers[0] + 1} on the robot" if transfers else ""
    return Picture(svg, f"{label}{runs}{after} (Figure 3).")


def _trajectories(network: Artefact, prefix: str, which: int, drive: dict[str, NDArray]) -> Picture:
    try:
        arena = Arena.from_json(network.json, network.meta["evolution"].get("arena") or {})
    except UserError:
        raise FileError(network.json, "expected an arena", field="evolution.arena") from None
    x1, y1, x2, y2 = 100 * np.array(arena.bounds)
    height = float(np.clip(5.4 * (y2 - y1) / (x2 - x1), 2.0, 6.0))
    with drawing(6.0, height + 0.7) as (figure, axes):
        draw_objects(axes, arena)
        axes.grid(visible=False)
        for name, ink, style in (("simulated", "predicted", "--"), ("robot", "actual", "-")):
            x, y = 100 * drive[name][:, :2].T
            axes.plot(x, y, color=INK[ink], ls=style, lw=1.4, label=name)
        x, y = 100 * drive["robot"][0, :2]
        axes.plot(x, y, "o", ms=5, mfc=INK["paper"], mec=INK["ink"])
        axes.set(xlim=(x1 - 2, x2 + 2), ylim=(y1 - 2, y2 + 2), aspect="equal")
        axes.set_xlabel("x, cm")
        axes.set_ylabel("y, cm")
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, borderaxespad=0)
        label = f"{network.name}: the same network in the simulator and on the robot"
        svg = to_svg(figure, label, prefix)
    return Picture(
        svg,
        f"{label}, start {which + 1} (Figure 4), the circle: {100 * _apart(drive):.1f} cm apart, "
        "median.",
    )


def _apart(drive: dict[str, NDArray]) -> float:
    """Return the median distance between simulator and robot, m."""
    count = min(map(len, drive.values()))
    off = drive["simulated"][:count, :2] - drive["robot"][:count, :2]
    return float(np.median(np.linalg.norm(off, axis=1)))


def _sensors(name: str, simulator: TableSimulator, prefix: str) -> Picture:
    mean = simulator.sensors.mean
    _, distances, angles, count = mean.shape
    # Rolled so that the object passes from the right (-180) over ahead (0) to the left (180).
    bearing = -360.0 * (np.arange(angles + 1) - angles // 2) / angles
    column = (np.arange(angles + 1) - angles // 2) % angles
    distance = 1000 * (
        simulator.sensors.first_distance + simulator.sensors.distance_step * np.arange(distances)
    )
    label = f"{name}: what each sensor reads by bearing and distance of a wall and of an obstacle"
    with drawing(9.6, 3.4, nrows=2, ncols=count, sharex=True, sharey=True) as (figure, axes):
        for kind, named in enumerate(OBJECTS):
            for sensor in range(count):
                panel = axes[kind][sensor]
                for level in LEVELS:
                    panel.contourf(
                        bearing, distance, mean[kind][:, column, sensor], [level, 1.01],
                        colors=[INK["predicted"]], alpha=0.25,
                    )  # fmt: skip
                if kind == 0:
                    panel.set_title(str(sensor))
                if sensor == 0:
                    panel.set_ylabel(f"{named}, mm")
                panel.set_xlim(180, -180)
                panel.set_xticks([90, -90])
        figure.supxlabel("bearing of the object, degrees to the left", fontsize=9)
        svg = to_svg(figure, label, prefix)
    levels = ", ".join(f"{level:g}" for level in LEVELS)
    return Picture(svg, f"{label}; darker where it reads above {levels}.", wide=True)


def _summary(simulator: TableSimulator) -> Table:
    sensors = simulator.sensors
    rows = []
    for sensor in range(sensors.mean.shape[-1]):
        row = [f"sensor {sensor}", f"{sensors.ambient[sensor]:.3f}"]
        for kind in range(len(OBJECTS)):
            turn = sensors.mean[kind, 0, :, sensor]
            # The middle of what it sees: a near object saturates over a wide angle.
            seen = np.maximum(turn - sensors.ambient[sensor], 0.0)
            to = (seen * np.exp(-2j * np.pi * np.arange(len(turn)) / len(turn))).sum()
            row += [f"{turn.max():.3f}", f"{np.degrees(np.angle(to)):+.0f}"]
        spread = sensors.spread
        row.append("not repeated" if spread is None else f"{spread[..., sensor].mean():.3f}")
        rows.append(row)
    return Table(
        f"Sensors: their highest reading at {1000 * sensors.first_distance:g} mm, and the mean "
        "bearing at which they see the object there",
        ["", "ambient", *(w for name in OBJECTS for w in (name, "at, deg")), "spread, mean"],
        rows,
    )


def _motors(name: str, simulator: TableSimulator) -> Table:
    motors = simulator.motors
    first, last = 0, len(motors.levels) - 1
    rows = []
    for left, right, words in (
        (last, last, "both forward"), (first, first, "both backward"),
        (first, last, "turning left"), (last, first, "turning right"),
    ):  # fmt: skip
        x, y, turn = motors.twist[left, right]
        cells = [f"{value:z.1f}" for value in (1000 * x, 1000 * y, np.degrees(turn))]
        if motors.spread is not None:
            cells[0] += f" +- {1000 * motors.spread[left, right, 0]:.1f}"
            cells[2] += f" +- {np.degrees(motors.spread[left, right, 2]):.1f}"
        rows.append([f"{words} at {motors.levels[last]:g} %", *cells])
    return Table(
        f"Motors: {len(motors.levels)} x {len(motors.levels)} settings of {name}",
        ["", "forward, mm/s", "sideways, mm/s", "turn, deg/s"],
        rows,
        note="" if motors.spread is None else "+-: of one second, where settings were repeated.",
    )
