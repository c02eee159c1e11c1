"""``neurosim record --guided``: rounds of recording, tracking, learning and choosing."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from neurosim.base.errors import FileError, UserError
from neurosim.base.files import check_new_folder
from neurosim.recording.commands import Command, CommandSource, RandomCommands

if TYPE_CHECKING:
    from neurosim.recording.record import RecordSettings
    from tracking.datasets.recordings import Recording

#: Where the robot is: x, y (m), heading (rad), on the board.
Pose = tuple[float, float, float]

#: How far inside the board's edge a chosen command is to end, m: the perimeter line lies about
#: half as far in, and the light sensors ahead of the axle.
MARGIN = 0.25


@dataclass(frozen=True)
class Rounds:
    """How many commands each round of a guided recording has.

    Attributes:
        commands: of the whole recording.
        size: of a round; the first, of random commands, is twice as long.
    """

    commands: int
    size: int

    def __post_init__(self) -> None:
        if self.size < 15:
            raise UserError(f"a round needs at least 15 commands, not {self.size}")
        if self.commands <= 2 * self.size:
            raise UserError(
                f"the first {2 * self.size} commands are random; --guided needs more than that, "
                f"not {self.commands}: a larger --commands or a smaller --round"
            )

    def numbers(self) -> list[range]:
        """Return the numbers of the commands of each round."""
        starts = [0, *range(2 * self.size, self.commands, self.size)]
        return [range(a, b) for a, b in zip(starts, [*starts[1:], self.commands], strict=True)]


def record_rounds(
    out: Path,
    opened: Callable[[int, Pose], AbstractContextManager[Any]],
    source: RandomCommands,
    settings: RecordSettings,
    size: int,
    calibration: Path,
    *,
    live: bool,
    resume: bool,
    options: dict[str, Any],
) -> list[Recording]:
    """Record in rounds, each a recording of its own in ``out``, tracked before the next.

    The first round's commands are random; those of the others are chosen by what an ensemble
    makes of all rounds before. A round's commands stand in its recording.json, with what chose
    them.

    Args:
        out: the folder of the rounds.
        opened: opens robot and camera for a session, from a seed of its chances and where the
            robot is; gives the rig, and what to show every frame to.
        source: of random commands, among which is chosen.
        settings: of the whole recording.
        size: of a round.
        calibration: of the camera.
        live: whether to track while recording.
        resume: go on with a recording that was interrupted.
        options: of the command line, kept in each round.

    Raises:
        UserError: if ``out`` is taken, or is complete, or was begun with other settings.
    """
    from neurosim.recording.record import record
    from tracking.datasets.recordings import Recording
    from tracking.track import track

    if settings.guard.at_line == "end":
        raise UserError("--at-line end would end the first round; leave it out with --guided")
    rounds = Rounds(settings.commands, size).numbers()
    if not resume:
        check_new_folder(out)
    elif not (out / _name(1)).is_dir():
        raise FileError(out, "holds no round of a guided recording; leave --resume out")
    elif is_whole(out, settings.commands, size):
        raise UserError(f"{out} is complete; there is nothing to resume")
    made: list[Recording] = []
    for number, numbers in enumerate(rounds, start=1):
        folder = out / _name(number)
        how = {
            "round": number,
            "rounds": len(rounds),
            "commands_in_all": settings.commands,
            "candidates": source.describe(),
        }
        begun = (folder / "recording.json").exists()
        # What was chosen before an interruption stands; with other settings it is refused.
        chosen = _chosen_before(folder, how) if begun else _choose(made, source, numbers, how)
        start = _end(made[-1]) if made else (0.0, 0.0, 0.0)
        there = Recording(folder) if begun else None
        if there is None or not there.meta["complete"]:
            _say(f"round {number} of {len(rounds)}: {len(numbers)} commands")
            sessions = sum(recording.sessions for recording in made)
            sessions += there.sessions if there else 0
            # Each session meets other chances, and begins where the last one ended.
            with opened(source.seed + 1000 * sessions, start) as (rig, on_seen):
                there = record(
                    folder,
                    rig.robot,
                    rig.camera,
                    chosen,
                    replace(settings, commands=len(numbers)),
                    calibration=calibration,
                    live=live,
                    on_seen=on_seen,
                    resume=begun,
                    finish=rig.finish,
                    lab=rig.lab,
                    options=options,
                )
        if not there.is_tracked:
            track(folder)
        made.append(there)
    return made


def is_whole(out: Path, commands: int, size: int) -> bool:
    """Return whether all rounds of a guided recording were recorded to their end and tracked."""
    rounds = len(Rounds(commands, size).numbers())
    return len(list(_complete(out, rounds))) == rounds


def parts_of(folder: Path) -> list[Path]:
    """Return the rounds of a guided recording; of anything else the folder itself."""
    if (folder / "recording.json").exists():
        return [folder]
    rounds = sorted(folder.glob("round-[0-9][0-9]*"), key=lambda path: (len(path.name), path.name))
    return rounds or [folder]


def _name(number: int) -> str:
    return f"round-{number:02d}"


def _complete(out: Path, rounds: int) -> Iterator[Path]:
    """Give the rounds that were recorded to their end and tracked."""
    from tracking.datasets.recordings import Recording

    for number in range(1, rounds + 1):
        folder = out / _name(number)
        if not (folder / "recording.json").exists():
            return
        there = Recording(folder)
        if not there.meta["complete"] or not there.is_tracked:
            return
        yield folder


def _chosen_before(folder: Path, how: dict[str, Any]) -> CommandSource:
    """Return the commands that a round was begun with."""
    from neurosim.training.guided import GuidedCommands
    from tracking.datasets.recordings import Recording

    path = folder / "recording.json"
    source = Recording(folder).meta.get("settings", {}).get("source", {})
    if source.get("kind") != "guided":
        raise FileError(path, "is no round of a guided recording", field="settings.source")
    for key, now in json.loads(json.dumps(how)).items():
        if source.get(key) != now:
            raise UserError(
                f"{folder} was recorded with another {key} ({source.get(key)!r}, now {now!r}); "
                "resume with the same settings, or start a new recording"
            )
    try:
        commands = [Command(*map(float, command)) for command in source["commands"]]
    except (KeyError, TypeError, ValueError):
        raise FileError(
            path, "expected a list of [left, right, duration]", field="settings.source.commands"
        ) from None
    kept = {key: value for key, value in source.items() if key not in ("kind", "commands")}
    return GuidedCommands(commands, kept)


def _choose(
    made: list[Recording], source: RandomCommands, numbers: range, how: dict[str, Any]
) -> CommandSource:
    """Return the commands of the next round: random ones where nothing is known yet."""
    from neurosim.base import files
    from neurosim.training.guided import (
        Committee,
        GuidedCommands,
        GuidedSettings,
        Place,
        choose,
        motor_data,
    )

    if not made:
        return GuidedCommands([source.command(n) for n in numbers], {**how, "chosen_by": "chance"})
    x, y = _rows(made)
    _say(
        f"round {how['round']} of {how['rounds']}: learning from {len(x)} commands, "
        f"then choosing {len(numbers)}"
    )
    choice = GuidedSettings()
    committee = Committee(motor_data(x, y), source.seed, choice)
    board = made[-1].meta["board"]
    place = Place(_end(made[-1]), board["length"] - 2 * MARGIN, board["width"] - 2 * MARGIN)
    commands = choose(committee, source, numbers, place, choice)
    learned_from = {
        f"{recording.path.name}/poses.csv": files.sha256(recording.path / "poses.csv")
        for recording in made
    }
    return GuidedCommands(
        commands,
        {
            **how,
            "chosen_by": "disagreement",
            "choice": asdict(choice),
            "rows": len(x),
            "learned_from": learned_from,
        },
    )


def _rows(made: list[Recording]) -> tuple[Any, Any]:
    """Return inputs (N, 5) and displacements (N, 3) of what was recorded so far."""
    from neurosim.training.train import MIN_ROWS
    from tracking.datasets.dataset import MOTOR_INPUTS, OUTPUTS
    from tracking.datasets.displacements import displacements

    rows = [row for recording in made for row in displacements(recording).rows]
    if len(rows) < MIN_ROWS:
        raise UserError(
            f"only {len(rows)} commands could be tracked so far, too few to learn from; "
            f"look at {made[-1].path} with neurosim report, or check the camera"
        )
    return tuple(
        np.array([[row[name] for name in names] for row in rows], float)
        for names in (MOTOR_INPUTS, OUTPUTS)
    )


def _end(recording: Recording) -> Pose:
    """Return where the robot was last seen."""
    poses = recording.poses()
    seen = poses.pose[poses.quality > 0]
    if not len(seen):
        return 0.0, 0.0, 0.0
    x, y, theta = map(float, seen[-1])
    return x, y, theta


def _say(message: str) -> None:
    print(message, file=sys.stderr, flush=True)
