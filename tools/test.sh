#!/usr/bin/env bash
# Set-up, linting, types and tests, in this order; stops at the first that fails. Arguments go to pytest:
#   bash tools/test.sh tests/geometry -k unproject
#   bash tools/test.sh -m slow
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

bash tools/setup.sh
python=.venv/bin/python
# The workers already use every core; more threads inside each would only wait for one another.
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}

run() { printf '\n$%s\n' "$(printf ' %q' "$@")"; "$@"; }

run $python -m ruff check .
run $python -m ruff format --check .
run $python -m mypy
run $python -m pytest -n logical "$@"
