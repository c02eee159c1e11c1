"""Simulators made of tables: the robot's samples, Lund and Miglino 1996."""

from __future__ import annotations

from typing import Any

import numpy as np

from neurosim.reports.artefacts import Artefacts
from neurosim.reports.page import Block, Picture, Section, Table
from neurosim.reports.svg import INK, drawing, to_svg
from neurosim.simulators.tables.sensor_table import SensorTable

#: Readings at which a sensor's picture gets darker.
LEVELS = (0.1, 0.3, 0.5, 0.7, 0.9)


def samples(artefacts: Artefacts) -> Section | None:
    """Write the section on the robot's samples; None without table simulators."""
    blocks: list[Block] = []
    for place, artefact in enumerate(artefacts.simulators):
        if artefact.sampled:
            simulator = artefact.content
            for sense, table in (("", simulator.sensors), ("light ", simulator.lights)):
                if table is not None:
                    picture = _sensors(artefact.name, table, f"{sense[:1]}t{place}")
                    blocks += [picture, _summary(table, sense)]
            blocks.append(_motors(artefact.name, simulator))
    return Section("samples", "Samples of the robot", blocks) if blocks else None


def _sensors(name: str, table: SensorTable, prefix: str) -> Picture:
    kinds, distances, angles, count = table.mean.shape
    # Rolled so that the object passes from the right (-180) over ahead (0) to the left (180).
    bearing = -360.0 * (np.arange(angles + 1) - angles // 2) / angles
    column = (np.arange(angles + 1) - angles // 2) % angles
    distance = 1000 * (table.first_distance + table.distance_step * np.arange(distances))
    objects = ", ".join(table.kinds)
    label = f"{name}: reading of each sensor by bearing and distance of an object ({objects})"
    size = {"nrows": kinds, "ncols": count, "squeeze": False}
    with drawing(9.6, 0.6 + 1.4 * kinds, sharex=True, sharey=True, **size) as (figure, axes):
        for kind, named in enumerate(table.kinds):
            for sensor in range(count):
                panel = axes[kind][sensor]
                for level in LEVELS:
                    panel.contourf(
                        bearing, distance, table.mean[kind][:, column, sensor], [level, 1.01],
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


def _summary(table: SensorTable, sense: str) -> Table:
    bearings = [table.bearings(kind) for kind in range(len(table.kinds))]
    rows = []
    for sensor in range(table.mean.shape[-1]):
        row = [f"{sense}sensor {sensor}", f"{table.ambient[sensor]:.3f}"]
        for kind in range(len(table.kinds)):
            highest, looks = table.mean[kind, 0, :, sensor].max(), bearings[kind][sensor]
            row.append(f"{highest:.3f}")
            row.append("sees nothing" if np.isnan(looks) else f"{np.degrees(looks):+.0f}")
        spread = table.spread
        row.append("not repeated" if spread is None else f"{spread[..., sensor].mean():.3f}")
        rows.append(row)
    title = f"{sense}sensors".capitalize()
    return Table(
        f"{title}: their highest reading at {1000 * table.first_distance:g} mm, and the mean "
        "bearing at which they see the object there",
        ["", "ambient", *(w for name in table.kinds for w in (name, "at, deg")), "spread, mean"],
        rows,
    )


def _motors(name: str, simulator: Any) -> Table:
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
