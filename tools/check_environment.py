"""Checks that the installed packages are the locked ones and that they work together in one process.

Run by ``tools/setup.sh`` with the interpreter of ``.venv``. Prints one line per package that the project
imports; exits with 1 and says what to do when something does not fit.
"""

import importlib
import sys
import time
from importlib.metadata import PackageNotFoundError, distributions, version
from pathlib import Path

LOCK = Path(__file__).resolve().parent.parent / "requirements.lock"

# Import name -> distribution name, in the order in which a process is likely to load them: torch brings
# its own OpenMP, and libraries that were linked against another one fail only when loaded beside it.
MODULES = {
    "torch": "torch",
    "numpy": "numpy",
    "cv2": "opencv-contrib-python-headless",
    "mediapipe": "mediapipe",
    "pycolmap": "pycolmap",
    "open3d": "open3d-cpu",
    "OpenEXR": "OpenEXR",
    "scipy": "scipy",
    "anny": "anny",
}


def locked_versions(lock: Path) -> dict[str, str]:
    """Distribution name -> exact version, from the ``name==version`` lines of a lock file."""
    lines = [line.strip() for line in lock.read_text(encoding="utf-8").splitlines()]
    return dict(line.split("==") for line in lines if line and not line.startswith("#"))


def version_problems(lock: Path) -> list[str]:
    """What is installed in another version than the lock says, or not at all.

    Local suffixes such as ``+cpu`` say how a package was built, not which one it is, and are ignored.
    """
    problems = []
    for name, pinned in locked_versions(lock).items():
        try:
            installed = version(name)
        except PackageNotFoundError:
            problems.append(f"{name}=={pinned} is not installed")
            continue
        if installed.split("+")[0] != pinned:
            problems.append(f"{name} is {installed}, but {lock.name} says {pinned}")
    return problems


def opencv_problems() -> list[str]:
    """The OpenCV wheels overwrite each other's files, so exactly one may be installed."""
    wheels = sorted(d.name for d in distributions() if d.name.lower().startswith("opencv"))
    return [] if len(wheels) == 1 else [f"exactly one OpenCV wheel may be installed, found {wheels}"]


def import_problems() -> list[str]:
    """Imports every module into this process and prints its version and the seconds that it took."""
    problems = []
    for module, distribution in MODULES.items():
        start = time.perf_counter()
        try:
            importlib.import_module(module)
        except Exception as error:  # a broken native library may raise anything at all
            problems.append(f"import {module} fails: {type(error).__name__}: {error}")
            continue
        print(f"  {module:<10} {version(distribution):<14} {time.perf_counter() - start:5.1f} s", flush=True)
    return problems


def main() -> int:
    """Prints the packages and their problems; 0 when there are none."""
    problems = version_problems(LOCK) + opencv_problems() + import_problems()
    for problem in problems:
        print(f"  problem: {problem}", file=sys.stderr)
    if problems:
        print(
            f"  remedy: bash tools/setup.sh with Python {sys.version.split()[0]}; "
            "if that does not help, remove .venv and run it again",
            file=sys.stderr,
        )
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
