"""Makes the helpers of the tests of alignment importable."""

import sys
from pathlib import Path

ALIGN = str(Path(__file__).resolve().parents[1] / "align")
if ALIGN not in sys.path:
    sys.path.insert(0, ALIGN)
