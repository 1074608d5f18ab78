"""The tool's package is imported from where a user runs it."""

import sys
from pathlib import Path

TOOLS = str(Path(__file__).parents[3] / "tools")
if TOOLS not in sys.path:
    sys.path.insert(0, TOOLS)

MODEL = Path(__file__).parents[2] / "model"
for folder in ("training", "fitting"):  # ball_heads: shards in closed form; small_fits: fits of a second
    if str(MODEL / folder) not in sys.path:
        sys.path.insert(0, str(MODEL / folder))
