"""Makes the helpers beside these tests, and those of alignment, importable."""

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
for folder in (HERE, HERE.parents[1] / "align"):
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
