"""Makes the tools importable, and the ball-shaped heads of the tests of training."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
for folder in (ROOT / "tools", ROOT / "tests" / "model" / "training"):
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
