"""How well a simulator predicts rows that it has not seen: Table 2 of Pretorius et al. (2009).

    python benchmarks/reference.py [DATASET] [--members N] [--json]

DATASET is a dataset, or a folder with the Odometry and Groundtruth files of a UTIAS recording. The
training is that of ``neurosim train DATASET``: all but the last fifth of the rows in time, with the
default settings. The ideal unicycle, fitted to the same rows, and the paper's own robot are printed
next to it.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

from neurosim.training.evaluate import UNITS, evaluate
from neurosim.training.train import train
from tracking.datasets.mrclam import import_mrclam

REFERENCE = Path(__file__).resolve().parents[1] / "data" / "reference"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("dataset", type=Path, nargs="?", default=REFERENCE)
    parser.add_argument("--members", type=int, default=16)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder, dataset = Path(name) / "simulator", options.dataset
        if not (dataset / "dataset.json").exists():
            import_mrclam(dataset, dataset := Path(name) / "dataset")
        simulator = train(dataset, folder, members=options.members)
        table = evaluate(folder, dataset)
    columns = {"neurosim": table["errors"], "paper": table["paper"]}
    if table["baseline"] is not None:
        columns["unicycle"] = table["baseline"]["errors"]
    errors = {
        name: {output: each[output]["mean_absolute_error"] for output in UNITS}
        for name, each in columns.items()
    }
    training = simulator.meta["training"]
    by_name = {key: training[key] for key in ("rows", "held_out_rows", "members", "seed")}
    by_name["errors"] = errors
    if options.json:
        print(json.dumps(by_name))
        return
    print(f"mean absolute errors on {table['rows']} rows, {table['which']}")
    for name, each in errors.items():
        shown = ", ".join(f"{output} {each[output]:.3f} {unit}" for output, unit in UNITS.items())
        print(f"{name:10} {shown}")


if __name__ == "__main__":
    main()
