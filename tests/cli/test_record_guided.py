"""``record --guided``, as a user runs it, killed and resumed."""

import json
import os
import signal

import numpy as np
import pytest
from processes import ended_by, neurosim

from neurosim.lab import read_truth
from neurosim.lab.nxt.params import BOARD
from neurosim.recording.commands import RandomCommands
from neurosim.recording.rounds import Rounds
from tracking.datasets.recordings import Recording

WORDS = ["record", "r", "--guided", "--commands", "45", "--round", "15", "--seed", "4"]


def test_rounds_are_all_commands_the_first_of_them_twice_as_long():
    assert Rounds(130, 25).numbers() == [
        range(50),
        range(50, 75),
        range(75, 100),
        range(100, 125),
        range(125, 130),
    ]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--camera", "none", "--calibration", "c.json"], "needs a camera"),
        ([], "--calibration"),
        (["--calibration", "c.json", "--at-line", "end"], "--at-line end"),
        (["--calibration", "c.json", "--commands", "30"], "needs more than the"),
        (["--calibration", "c.json", "--resume"], "no round"),
    ],
)
def test_what_cannot_be_guided_is_refused_in_a_sentence(words, says, refused):
    assert says in refused(*WORDS, *words)


@pytest.mark.skipif(os.name == "nt", reason="Windows has no kill -9")
def test_a_guided_recording_that_is_killed_goes_on_with_what_it_had_chosen(pipeline, tmp_path):
    words = [*WORDS, "--calibration", str(pipeline / "calibration.json")]
    log = "r/round-02/commands.csv"
    killed = ended_by("SIGKILL", words, log=log, count=5, word="command", cwd=tmp_path)
    assert killed.returncode == -signal.SIGKILL
    assert "round 2 of 2: learning from" in killed.stderr
    chosen = Recording(tmp_path / "r" / "round-02").meta["settings"]["source"]
    refused = neurosim(*words, "--resume", "--max-speed", "40", cwd=tmp_path, check=False)
    assert refused.returncode == 1
    assert "candidates" in refused.stderr

    printed = json.loads(neurosim("record", "r", "--resume", "--json", cwd=tmp_path).stdout)
    assert printed["sessions"] == 3
    assert [os.path.basename(path) for path in printed["rounds"]] == ["round-01", "round-02"]
    recordings = [Recording(tmp_path / path) for path in printed["rounds"]]
    assert all(recording.meta["complete"] for recording in recordings)
    assert recordings[1].meta["settings"]["source"] == chosen
    assert chosen["chosen_by"] == "disagreement"
    assert chosen["learned_from"].keys() == {"round-01/poses.csv"}
    assert len(chosen["commands"]) == 15
    sent = {
        line.command: [line.left, line.right, line.duration]
        for line in recordings[1].commands().itertuples()
        if line.kind == "command"
    }
    assert [sent[number] for number in range(15)] == chosen["commands"]
    source = RandomCommands(seed=4)
    for number, command in enumerate(chosen["commands"], start=30):
        commands_sampled = [source.command(8 * number + k) for k in range(8)]
        assert command in [list(c.row) for c in commands_sampled]
    for recording in recordings:
        truth = read_truth(recording.path, recording.sessions)  # a killed session leaves none
        place = np.abs(truth.poses[:, :2])
        assert (place < [BOARD.length / 2, BOARD.width / 2]).all()

    over = neurosim(*words, "--resume", cwd=tmp_path, check=False)
    assert over.returncode == 1
    assert "nothing to resume" in over.stderr
    made = neurosim("dataset", *printed["rounds"], "-o", "d", "--json", cwd=tmp_path)
    assert json.loads(made.stdout)["rows"] >= 40
    neurosim("dataset", "r", "-o", "e", cwd=tmp_path)  # its folder stands for all rounds
    tables = [(tmp_path / name / "dataset.csv").read_bytes() for name in ("d", "e")]
    assert tables[0] == tables[1]
