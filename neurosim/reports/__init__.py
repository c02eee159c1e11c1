"""One self-contained HTML page of a dataset, a simulator, a controller and its trials.

:func:`neurosim.reports.report.write_report` is the entry. Modules are imported when they are used,
because matplotlib is slow to start.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

__all__ = ["write_report"]


def write_report(folders: Sequence[str | Path], out: str | Path) -> dict[str, Any]:
    """Write the report; see :func:`neurosim.reports.report.write_report`."""
    from neurosim.reports import report

    return report.write_report(folders, out)
