import json
import math
import os
import re
import signal
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neurosim.base import files
from neurosim.base.errors import FileError, UserError
from neurosim.base.formats import Format


class Thing(Format):
    x: float
    y: list[int]


class Counted(Format):
    x: int


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.txt"
    files.write_text(path, "old")
    with pytest.raises(RuntimeError), files.atomic_path(path) as partial:
        partial.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_a_folder_appears_whole_or_not_at_all(tmp_path):
    with pytest.raises(RuntimeError), files.new_folder(tmp_path / "out") as folder:
        (folder / "half").write_text("x")
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []
    with files.new_folder(tmp_path / "out") as folder:
        (folder / "whole").write_text("x")
    assert (tmp_path / "out" / "whole").read_text() == "x"


def test_a_folder_with_something_in_it_is_refused(tmp_path):
    (tmp_path / "mine").write_text("precious")
    with pytest.raises(UserError, match="is not empty"), files.new_folder(tmp_path):
        pass
    with pytest.raises(UserError, match="is a file"), files.new_folder(tmp_path / "mine"):
        pass


def test_a_place_in_a_file_is_refused(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="file is a file; name a folder"):
        files.write_text(tmp_path / "file" / "deeper" / "x", "x")
    with (
        pytest.raises(UserError, match="file is a file"),
        files.new_folder(tmp_path / "file" / "x"),
    ):
        pass


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_a_device_is_never_replaced(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(UserError, match="pipe is a device; name a file to write"):
        files.write_text(pipe, "x")
    with pytest.raises(UserError, match="pipe is a device; name a folder"), files.new_folder(pipe):
        pass
    with pytest.raises(FileError, match="is a pipe or a device; expected a CSV file"):
        files.LineLog(pipe, ["a"])
    assert pipe.is_fifo()
    assert list(tmp_path.iterdir()) == [pipe]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system limits no file's size")
@pytest.mark.parametrize("write", [files.write_tensors, files.write_csv])
def test_a_disk_that_takes_no_more_is_an_error_of_the_system(tmp_path, write):
    import resource

    columns, limits = {"w": np.ones(10_000)}, resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises(OSError, match="too large"):
            write(tmp_path / "w", columns)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, ignored)
    assert list(tmp_path.iterdir()) == []


def test_json_keeps_its_content_and_says_format_and_version(tmp_path):
    path = tmp_path / "a.json"
    files.write_json(path, "thing", 2, {"x": np.float64(1.5), "y": np.arange(3)})
    assert json.loads(path.read_text()) == {
        "format": "thing",
        "version": 2,
        "x": 1.5,
        "y": [0, 1, 2],
    }
    assert files.read_json(path, "thing", 2, Thing)["x"] == 1.5


def test_json_has_no_word_for_nan(tmp_path):
    with pytest.raises(ValueError, match="not JSON compliant"):
        files.write_json(tmp_path / "a.json", "thing", 1, {"x": math.nan})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('{"format": "thing", "version": 1, "x": 1', "line 1: is not whole JSON"),
        ('{"format": "other", "version": 1, "x": 1}', "field 'format': expected 'thing'"),
        ('{"format": "thing", "version": 9, "x": 1}', "reads version 1, found 9"),
        ('{"format": "thing", "version": true, "x": 1}', "reads version 1, found True"),
        ('{"format": "thing", "version": 1}', "field 'x': is missing"),
        (
            '{"format": "thing", "version": 1, "x": "1"}',
            "field 'x': expected a whole number, found '1'",
        ),
        (
            '{"format": "thing", "version": 1, "x": true}',
            "field 'x': expected a whole number, found True",
        ),
        ("[]", "expected a JSON object"),
    ],
)
def test_json_that_is_wrong_is_refused_in_one_sentence(tmp_path, text, says):
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(FileError) as error:
        files.read_json(path, "thing", 1, Counted)
    assert says in str(error.value)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "line 1: is empty"),
        ("a\n1\n", "field 'b': this column is missing"),
        ("a,b\n1,x\n", "line 2, field 'b': expected a finite number, found 'x'"),
        ("a,b\n1,1\n2,nan\n", "line 3, field 'b': expected a finite number, found 'nan'"),
        ("a,b\n1.5,1\n", "line 2, field 'a': expected a whole number, found '1.5'"),
        ("a,b\n1\n", "line 2: expected 2 fields (a, b), found 1"),
    ],
)
def test_csv_that_is_wrong_is_refused_with_line_and_field(tmp_path, text, says):
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(FileError) as error:
        files.read_csv(path, {"a": files.integer, "b": files.number})
    assert says in str(error.value)


@given(st.lists(st.floats(-files.LARGEST, files.LARGEST), max_size=20))
def test_numbers_survive_a_csv_to_the_last_bit(tmp_path_factory, values):
    path = tmp_path_factory.mktemp("csv") / "a.csv"
    files.write_csv(path, {"a": values})
    assert files.read_csv(path, {"a": files.number})["a"].tolist() == values


@pytest.mark.parametrize("text", ["inf", "nan", "1e308", "-1.5e150"])
def test_a_number_that_nothing_was_measured_as_is_refused(tmp_path, text):
    (tmp_path / "a.csv").write_text(f"a\n1\n{text}\n")
    with pytest.raises(FileError, match=f"line 3.*'a'.*expected a finite number.*{text}"):
        files.read_csv(tmp_path / "a.csv", {"a": files.number})


def test_a_line_log_drops_a_torn_line_and_goes_on(tmp_path):
    path = tmp_path / "log.csv"
    with files.LineLog(path, ["a", "b"]) as log:
        log.append(1, 0.1)
        log.append(None, math.nan)
    path.write_bytes(path.read_bytes() + b"3,0.")
    columns = {"a": str, "b": files.optional_number}
    assert files.read_csv(path, columns, drop_torn_line=True)["a"].tolist() == ["1", ""]
    with files.LineLog(path, ["a", "b"]) as log:
        log.append(4, 0.4)
    assert path.read_text() == "a,b\n1,0.1\n,\n4,0.4\n"


def test_a_line_log_of_other_columns_is_refused(tmp_path):
    files.LineLog(tmp_path / "log.csv", ["a"]).close()
    with pytest.raises(FileError, match="expected the columns a, b"):
        files.LineLog(tmp_path / "log.csv", ["a", "b"])


@pytest.mark.skipif(os.name == "nt", reason="Windows has no kill -9")
def test_every_line_before_a_kill_is_on_disk(tmp_path):
    program = (
        "import sys; from neurosim.base.files import LineLog\n"
        f"log = LineLog({str(tmp_path / 'log.csv')!r}, ['n'])\n"
        "for n in range(10**9):\n log.append(n); print(n, flush=True)\n"
    )
    child = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    seen = [int(child.stdout.readline()) for _ in range(50)][-1]
    child.send_signal(signal.SIGKILL)
    child.wait()
    child.stdout.close()
    table = files.read_csv(tmp_path / "log.csv", {"n": files.integer}, drop_torn_line=True)
    assert table["n"].tolist()[: seen + 1] == list(range(seen + 1))


def test_tensors_that_were_cut_short_are_refused(tmp_path):
    path = tmp_path / "w.safetensors"
    files.write_tensors(path, {"w": np.ones((2, 3))})
    assert files.read_tensors(path, {"w": (None, 3)})["w"].shape == (2, 3)
    with pytest.raises(FileError, match=r"expected shape \(3, 2\), found \(2, 3\)"):
        files.read_tensors(path, {"w": (3, 2)})
    with pytest.raises(FileError, match="'v': this tensor is missing"):
        files.read_tensors(path, {"v": (3,)})
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(FileError, match="cut short"):
        files.read_tensors(path)
    files.write_tensors(path, {"w": np.array([1.0, math.nan])})
    with pytest.raises(FileError, match="not finite"):
        files.read_tensors(path, {"w": (2,)})


def test_a_temporary_name_follows_no_link_and_cannot_be_foreseen(tmp_path):
    names = set()
    for _ in range(3):
        with files.atomic_path(tmp_path / "a.json") as partial:
            partial.write_text("x")
            names.add(partial.name)
            assert partial.suffix == ".json"
    assert len(names) == 3
    # Where a link has a random name already, another name is used.
    (tmp_path / "mine").write_text("mine")
    sampled = iter(["taken", "free"])
    (tmp_path / ".a.taken.partial.json").symlink_to(tmp_path / "mine")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files.tempfile, "_get_candidate_names", lambda: sampled)
        files.write_text(tmp_path / "a.json", "new")
    assert (tmp_path / "mine").read_text() == "mine"
    assert (tmp_path / "a.json").read_text() == "new"


@pytest.mark.parametrize("kind", ["atomic_path", "new_folder"])
def test_what_a_killed_program_left_is_removed_after_a_day(tmp_path, kind):
    place = tmp_path / "a[1].x"
    name = {"atomic_path": ".a[1].123.partial.x", "new_folder": ".a[1].x.partial-123"}[kind]
    left, own = tmp_path / name, tmp_path / name.replace("123", "456")
    for path in (left, own):
        path.mkdir() if kind == "new_folder" else path.touch()
    os.utime(left, (0, 0))
    with getattr(files, kind)(place) as partial:
        assert not left.exists()
        (partial / "whole" if partial.is_dir() else partial).write_text("whole")
    assert sorted(tmp_path.iterdir()) == sorted([own, place])  # another program may be using it


def test_a_folder_that_was_moved_aside_is_put_back(tmp_path):
    aside = tmp_path / ".out.old-abc"
    aside.mkdir()
    (aside / "precious").write_text("mine")
    with pytest.raises(RuntimeError), files.new_folder(tmp_path / "out", overwrite=True):
        raise RuntimeError
    assert (tmp_path / "out" / "precious").read_text() == "mine"
    with files.new_folder(tmp_path / "out", overwrite=True) as folder:
        (folder / "new").touch()
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_folder_with_leftovers_alone_is_empty(tmp_path):
    assert files.is_empty(tmp_path / "nothing")
    for name in (".lock", ".recording.abc.partial.json", ".recording.123.partial.json"):
        (tmp_path / name).touch()
    assert files.is_empty(tmp_path)
    (tmp_path / ".mine").touch()
    assert not files.is_empty(tmp_path)


HOLDS = """
import sys
from neurosim.base import files
with files.locked({folder!r}, "recorded into"):
    print("holds", flush=True)
    sys.stdin.readline()
"""


def holder(folder):
    child = subprocess.Popen(
        [sys.executable, "-c", HOLDS.format(folder=str(folder))],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert child.stdout.readline() == b"holds\n"
    return child


def test_a_folder_is_one_process_own(tmp_path):
    child = holder(tmp_path)
    try:
        says = (
            rf"is being recorded into by process {child.pid} on .+: wait until it ends, or end it$"
        )
        with pytest.raises(UserError, match=says), files.locked(tmp_path, "recorded into"):
            pass
        with pytest.raises(UserError, match=says):
            files.check_free(tmp_path, "recorded into")
    finally:
        child.communicate(b"\n")
    assert list(tmp_path.iterdir()) == []
    files.check_free(tmp_path, "recorded into")
    assert list(tmp_path.iterdir()) == []
    with files.locked(tmp_path, "recorded into"):
        assert [path.name for path in tmp_path.iterdir()] == [".lock"]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.name == "nt", reason="Windows has no kill -9")
def test_the_lock_of_a_process_that_is_no_more_does_not_count(tmp_path):
    child = holder(tmp_path)
    child.kill()
    child.communicate()
    assert (tmp_path / ".lock").read_text().startswith(f"process {child.pid} on ")
    with files.locked(tmp_path, "recorded into"):
        assert (tmp_path / ".lock").read_text().startswith(f"process {os.getpid()} on ")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('{"x": ' + "9" * 5000 + "}", "of 5000 digits is too large"),
        ('{"x": ' + "9" * 25 + "}", "of 25 digits is too large"),
        ('{"x": 1e999}', "1e999 cannot be written as a number"),
        ('{"x": NaN}', "NaN cannot be written as a number"),
        ('{"x": -Infinity}', "-Infinity cannot be written as a number"),
        ('{"x": ' + "[" * 100_000, "is nested too deeply; expected a thing file"),
        ('{"x": ' + '{"y": ' * 100_000, "is nested too deeply; expected a thing file"),
        ('{"x": 1, "x": 2}', "the key 'x' appears twice"),
    ],
)
def test_json_of_what_no_program_writes_is_refused(tmp_path, text, says):
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(FileError, match=says):
        files.read_json(path, "thing", 1)


def test_large_numbers_that_fit_are_read(tmp_path):
    files.write_json(tmp_path / "a.json", "thing", 1, {"x": 2**64 - 1, "y": -(2**63), "z": 1e300})
    assert files.read_json(tmp_path / "a.json", "thing", 1)["x"] == 2**64 - 1


READERS = [
    lambda path: files.read_json(path, "thing", 1),
    lambda path: files.read_csv(path, {"a": str}),
    lambda path: files.read_tensors(path),
    files.read_header,
    files.sha256,
    lambda path: files.read_text(path, "text"),
]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
@pytest.mark.parametrize("read", READERS)
def test_what_is_no_file_is_not_waited_for(tmp_path, read):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to("loop")
    for name, says in (
        ("pipe", "is a pipe or a device"),
        ("loop", r"cannot be read \(Too many levels of symbolic links\)"),
        ("none", "no such file"),
        ("", "is a folder"),
    ):
        with pytest.raises(FileError, match=says):
            read(tmp_path / name)
    with pytest.raises(FileError, match="is a pipe or a device"):
        read("/dev/zero")


def test_a_folder_of_another_kind_is_named(tmp_path):
    (tmp_path / "simulator.json").write_text("{}")
    end = f"expected a b file, JSON in UTF-8, but {tmp_path} is a simulator"
    with pytest.raises(FileError, match=f"dataset.json: no such file; {re.escape(end)}$"):
        files.read_json(tmp_path / "dataset.json", "b", 1)
    with pytest.raises(FileError, match=r"expected a CSV file$"):
        files.check_file(tmp_path / "rows.csv", "a CSV file")


def test_a_file_that_is_too_large_is_refused_before_it_is_read(tmp_path):
    with open(tmp_path / "a.json", "wb") as file:
        file.truncate(files.MOST_JSON + 1)
    with pytest.raises(FileError, match="is larger than 64 MB; expected a thing file"):
        files.read_json(tmp_path / "a.json", "thing", 1)


def test_a_field_that_never_ends_is_no_number(tmp_path):
    (tmp_path / "a.csv").write_text("a,b\n1," + "2" * 200_000 + "\n")
    with pytest.raises(FileError, match=r"line 2, field 'b': expected a finite number, .{60,80}$"):
        files.read_csv(tmp_path / "a.csv", {"b": files.number})


@pytest.mark.parametrize("text", ['a,b\n"1,2\n3,4\n', 'a,b\n"1\n2",3\n', 'a,"b\n1,2\n', "a\n\0\n"])
def test_a_field_over_several_lines_is_refused(tmp_path, text):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(FileError):
        files.read_csv(tmp_path / "a.csv", {"a": files.number})


def test_a_table_knows_its_lines_and_quotes(tmp_path):
    (tmp_path / "a.csv").write_text('a,b\n\n"x, y",1\n\nz,2\n')
    table = files.read_csv(tmp_path / "a.csv", {"a": str, "b": files.integer})
    assert table.index.tolist() == [3, 5]
    assert table["a"].tolist() == ["x, y", "z"]


def test_a_name_that_is_not_utf_8_is_refused():
    assert files.check_name("é/ü.avi") == "é/ü.avi"
    with pytest.raises(FileError, match=r"a\\udcff\.avi.*the name is not UTF-8; rename the file"):
        files.check_name(os.fsdecode(b"a\xff.avi"))


def test_lines_of_json_drop_a_torn_line_and_go_on(tmp_path):
    path = tmp_path / "lines.jsonl"
    log = files.JsonLines(path, "lines", 1, {"about": {"size": (1, 2)}})
    log.append({"value": 0.1})
    log.append({"value": np.float64(1 / 3)})
    log.close()
    with path.open("ab") as file:
        file.write(b'{"value": 0.')
    again = files.JsonLines(path, "lines", 1, {"about": {"size": (1, 2)}})
    assert again.rows == [{"value": 0.1}, {"value": 1 / 3}]
    again.append({"value": 2})
    assert [json.loads(line).get("value") for line in path.read_text().splitlines()] == [
        None, 0.1, 1 / 3, 2,
    ]  # fmt: skip
    with pytest.raises(ValueError, match="JSON"):
        again.append({"value": math.nan})
    assert len(path.read_text().splitlines()) == 4


def test_lines_of_json_of_something_else_are_refused(tmp_path):
    path = tmp_path / "lines.jsonl"
    files.JsonLines(path, "lines", 1, {"about": 1}).close()
    with pytest.raises(FileError, match="line 1, field 'about': expected 2, found 1"):
        files.JsonLines(path, "lines", 1, {"about": 2})
    path.write_text(path.read_text() + "[1]\n")
    with pytest.raises(FileError, match="line 2: expected a JSON object"):
        files.JsonLines(path, "lines", 1, {"about": 1})


def test_tensors_of_more_dimensions_than_there_can_be_are_refused(tmp_path):
    header = json.dumps({"a": {"dtype": "F64", "shape": [1] * 1000, "data_offsets": [0, 8]}})
    data = len(header).to_bytes(8, "little") + header.encode() + b"\0" * 8
    (tmp_path / "a.safetensors").write_bytes(data)
    with pytest.raises(FileError, match="is not a whole safetensors file"):
        files.read_tensors(tmp_path / "a.safetensors")


def test_tensors_of_half_precision_are_refused(tmp_path):
    files.write_tensors(tmp_path / "a.safetensors", {"a": np.zeros(3, np.float16)})
    with pytest.raises(FileError, match="'a': expected float32 or float64, found float16"):
        files.read_tensors(tmp_path / "a.safetensors", {"a": (3,)})
