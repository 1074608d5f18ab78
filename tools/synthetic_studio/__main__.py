"""`python tools/synthetic_studio`: makes the package importable, then runs its command line."""

import sys
from pathlib import Path

if __name__ == "__main__":
    here = Path(__file__).resolve().parent
    # Run as a directory, Python puts the package's own folder first, where its modules would shadow others.
    sys.path[:] = [entry for entry in sys.path if Path(entry or ".").resolve() != here]
    sys.path.insert(0, str(here.parent))
    # Lets a checkout run before it has been installed.
    sys.path.append(str(here.parent.parent))

    from synthetic_studio.cli import main

    sys.exit(main())
