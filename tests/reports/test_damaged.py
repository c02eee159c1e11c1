"""Artefacts that somebody changed: for any content, one sentence says what is wrong."""

import json
import random
import shutil

import pytest
from report_artefacts import make_controller, make_dataset, make_simulator, make_trial

from neurosim.base.errors import UserError
from neurosim.reports.report import write_report

VALUES = (None, "x", -1, 0, [], {}, 1e300, 2**63, True, [1], [[1, 2]], {"a": 1}, "../../..")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    make_dataset(folder / "dataset", rows=60)
    make_simulator(folder / "simulator", folder / "dataset")
    make_controller(folder / "controller")
    make_trial(folder / "trial")
    return folder


def nodes(value, path=()):
    """Give the places in a JSON document; of a list the first two."""
    if path:
        yield path
    inner = value.items() if isinstance(value, dict) else ()
    if isinstance(value, list):
        inner = list(enumerate(value))[:2]
    for key, each in inner:
        yield from nodes(each, (*path, key))


def changed(document, path, value):
    """Return a document with another value at a key; with the key left out for ``...``."""
    document = json.loads(json.dumps(document))
    place = document
    for key in path[:-1]:
        place = place[key]
    if value is ...:
        del place[path[-1]]
    else:
        place[path[-1]] = value
    return document


def attack(made, folder, kind, cases, seed):
    rng = random.Random(seed)
    source = made / kind / f"{kind}.json"
    document = json.loads(source.read_text())
    places = [path for path in nodes(document) if path[0] not in ("format", "version")]
    shutil.copytree(made / kind, folder / kind)
    for _ in range(cases):
        path, value = rng.choice(places), rng.choice([*VALUES, ...])
        text = json.dumps(changed(document, path, value))
        (folder / kind / f"{kind}.json").write_text(text)
        try:
            write_report([folder / kind], folder / "page.html")
        except UserError:
            continue
        except Exception as error:
            raise AssertionError(f"{kind}.json: {path} = {value!r}") from error


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["dataset", "simulator", "controller", "trial"])
def test_a_few_changes(made, tmp_path, kind):
    attack(made, tmp_path, kind, 12, seed=1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["dataset", "simulator", "controller", "trial"])
def test_many_changes(made, tmp_path, kind):
    attack(made, tmp_path, kind, 40, seed=2)
