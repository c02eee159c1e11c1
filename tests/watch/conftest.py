import sys
from pathlib import Path

# The scene that the tracker's tests paint.
sys.path.append(str(Path(__file__).resolve().parents[1] / "tracking"))
