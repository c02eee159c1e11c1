"""Recordings in rounds: the rounds so far determine the commands of the next one."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Protocol

from msgspec import Meta

from neurosim.base.checkpoint import difference
from neurosim.base.declared import Checked, Count
from neurosim.base.errors import FileError, UserError
from neurosim.base.files import check_new_folder, check_no_links, locked
from neurosim.recording.commands import Command, CommandSource, FixedCommands, RandomCommands
from neurosim.recording.record import record
from neurosim.recording.settings import RecordSettings
from tracking.datasets.recordings import Recording
from tracking.track import track

#: A robot's pose on the board: x, y (m), heading (rad).
Pose = tuple[float, float, float]


@dataclass(frozen=True)
class Rounds(Checked):
    """How many commands each round has.

    Attributes:
        commands: Number of commands of the whole recording.
        size: Commands of a round of --guided; the first round has twice as many, all random.
    """

    commands: Count
    size: Annotated[int, Meta(ge=15, le=1000000)] = 50

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.commands <= 2 * self.size:
            raise UserError(
                f"--guided needs more than the {2 * self.size} random commands of its first round, "
                f"not {self.commands}: give a larger --commands or a smaller --round"
            )

    def numbers(self) -> list[range]:
        """Return the numbers of the commands of each round."""
        starts = [0, *range(2 * self.size, self.commands, self.size)]
        return [range(a, b) for a, b in zip(starts, [*starts[1:], self.commands], strict=True)]


class Choose(Protocol):
    """Chooses the commands of a round; see :func:`neurosim.training.guided.choose_round`."""

    def __call__(
        self, made: list[Recording], source: RandomCommands, numbers: range, pose: Pose
    ) -> tuple[list[Command], dict[str, Any]]:
        """Return the commands, and the description of the choice for the recording.

        Args:
            made: the rounds so far, tracked.
            source: of the random commands, from which the choice is made.
            numbers: numbers of the commands to choose.
            pose: pose of the robot.
        """
        ...


def record_rounds(
    out: Path,
    opened: Callable[[int, Pose], AbstractContextManager[Any]],
    source: RandomCommands,
    settings: RecordSettings,
    rounds: Rounds,
    choose: Choose,
    calibration: Path,
    *,
    live: bool = True,
    resume: bool = False,
    options: Mapping[str, Any] | None = None,
) -> list[Recording]:
    """Record in rounds, each a recording of its own in ``out``, tracked before the next.

    The commands of the first round are random; those of the others are chosen by what was recorded
    before. A round's ``recording.json`` has its commands and how they were chosen.

    Args:
        out: the folder of the rounds.
        opened: opens robot and camera for a session, from the seed of its noise and the robot's
            pose; gives the rig (:class:`neurosim.recording.settings.Rig`), and a viewer of every
            frame, or None.
        source: of the random commands, from which the choice is made.
        settings: of the whole recording.
        rounds: their sizes.
        choose: chooses the commands of a round.
        calibration: of the camera.
        live: whether to track while recording.
        resume: continue a recording that was interrupted.
        options: of the command line, kept in each round.

    Raises:
        UserError: if ``out`` is taken, or is complete, or was begun with other settings.
    """
    if settings.guard.at_line == "end":
        raise UserError("--at-line end would end the first round; leave it out if you use --guided")
    numbers = rounds.numbers()
    if resume:
        check_no_links(out)
    if not resume:
        check_new_folder(out)
    elif not (out / _name(1)).is_dir():
        raise FileError(out, "holds no round of a guided recording; leave --resume out")
    elif is_whole(out, rounds):
        raise UserError(f"{out} is complete; there is nothing to resume")
    made: list[Recording] = []
    held = False
    with ExitStack() as kept:
        for number, indices in enumerate(numbers, start=1):
            folder = out / _name(number)
            if out.exists() and not held:  # the first round makes it
                kept.enter_context(locked(out, "recorded into"))
                held = True
            how = {
                "kind": "guided",
                "round": number,
                "rounds": len(numbers),
                "commands_in_all": settings.commands,
                "candidates": source.describe(),
            }
            begun = (folder / "recording.json").exists()
            start = _end(made[-1]) if made else (0.0, 0.0, 0.0)
            # The choice before an interruption is kept; other settings are an error.
            chosen = _chosen_before(folder, how) if begun else None
            if chosen is None and made:
                _say(
                    f"round {number} of {len(numbers)}: learning from all rounds so far, then "
                    f"choosing {len(indices)} commands"
                )
                candidates = replace(source, takes=made[0].takes)
                commands, choice = choose(made, candidates, indices, start)
                chosen = FixedCommands(commands, {**how, **choice})
            there = Recording(folder) if begun else None
            if there is None or not there.meta["complete"]:
                _say(f"round {number} of {len(numbers)}: {len(indices)} commands")
                sessions = sum(recording.sessions for recording in made)
                sessions += there.sessions if there else 0
                # Each session has its own noise, and begins where the last one ended.
                with opened(source.seed + 1000 * sessions, start) as (rig, on_seen):
                    if chosen is None:
                        first = replace(source, takes=rig.robot.commands)
                        random = [first.command(index) for index in indices]
                        chosen = FixedCommands(random, {**how, "chosen_by": "chance"})
                    there = record(
                        folder,
                        rig,
                        chosen,
                        replace(settings, commands=len(indices)),
                        calibration=calibration,
                        live=live,
                        on_seen=on_seen,
                        resume=begun,
                        options=options,
                    )
            if not there.is_tracked:
                track(folder)
            made.append(there)
    return made


def is_whole(out: Path, rounds: Rounds) -> bool:
    """Return whether all rounds of a guided recording are complete and tracked."""
    count = len(rounds.numbers())
    return len(list(_complete(out, count))) == count


def parts_of(folder: Path) -> list[Path]:
    """Return the rounds of a guided recording; for another folder, the folder itself."""
    if (folder / "recording.json").exists():
        return [folder]
    rounds = sorted(folder.glob("round-[0-9][0-9]*"), key=lambda path: (len(path.name), path.name))
    return rounds or [folder]


def _name(number: int) -> str:
    return f"round-{number:02d}"


def _complete(out: Path, rounds: int) -> Iterator[Path]:
    """Give the rounds that are complete and tracked."""
    for number in range(1, rounds + 1):
        folder = out / _name(number)
        if not (folder / "recording.json").exists():
            return
        there = Recording(folder)
        if not there.meta["complete"] or not there.is_tracked:
            return
        yield folder


def _chosen_before(folder: Path, how: Mapping[str, Any]) -> CommandSource:
    """Return the commands with which a round was begun."""
    path = folder / "recording.json"
    source = Recording(folder).meta.get("settings", {}).get("source", {})
    if source.get("kind") != how["kind"]:
        raise FileError(path, "is not a round of a guided recording", field="settings.source")
    same = {key: source.get(key) for key in how}
    if (wrong := difference(same, json.loads(json.dumps(how)))) is not None:
        raise UserError(
            "{} was recorded with another {} ({!r}, now {!r}); resume with the same settings, "
            "or start a new recording".format(folder, *wrong)
        )
    try:
        commands = [Command.of(command) for command in source["commands"]]
    except (KeyError, TypeError, ValueError):
        raise FileError(
            path, "expected a list of rows of numbers", field="settings.source.commands"
        ) from None
    kept = {key: value for key, value in source.items() if key != "commands"}
    return FixedCommands(commands, kept)


def _end(recording: Recording) -> Pose:
    """Return the last seen pose of the robot."""
    poses = recording.poses().certain()
    seen = poses.pose[poses.quality > 0]
    if not len(seen):
        return 0.0, 0.0, 0.0
    x, y, theta = map(float, seen[-1])
    return x, y, theta


def _say(message: str) -> None:
    print(message, file=sys.stderr, flush=True)
