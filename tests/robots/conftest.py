"""The robots' tests drive virtual bricks, with the body that the lab's own tests use."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1] / "lab"))
