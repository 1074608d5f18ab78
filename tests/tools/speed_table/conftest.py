"""The tool's package is imported from where a user runs it."""

import sys
from pathlib import Path

TOOLS = str(Path(__file__).parents[3] / "tools")
if TOOLS not in sys.path:
    sys.path.insert(0, TOOLS)
