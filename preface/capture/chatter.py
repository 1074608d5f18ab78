"""What native libraries say on standard error although nothing is wrong, and no setting of theirs keeps them from it.

A line that reads as a failure makes a user look for one. All that is not known to be noise is passed on.
"""

import contextlib
import os
import re
import sys
import tempfile
from collections.abc import Iterator


@contextlib.contextmanager
def without_chatter(noise: re.Pattern[str]) -> Iterator[None]:
    """Hold back what native code writes to standard error, and then pass on the lines that do not begin with noise."""
    sys.stderr.flush()
    with tempfile.TemporaryFile() as held:
        original = os.dup(2)
        os.dup2(held.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(original, 2)
            os.close(original)
            held.seek(0)
            lines = held.read().decode(errors="replace").splitlines(keepends=True)
            sys.stderr.write("".join(line for line in lines if not noise.match(line)))
