"""The README's table of speed for accuracy, made of measurements that are kept with the repository.

    python tools/speed_for_accuracy.py keep calibration tradeoff.json --of "520 images of 1024x1536, two cores"
    python tools/speed_for_accuracy.py keep training prior/ --name small --of "64 people, two cores"
    python tools/speed_for_accuracy.py keep real-faces real/person/table.json --name person --of "A walk-around"
    python tools/speed_for_accuracy.py write

`keep` copies what a bench wrote to tools/measured/, without the paths of the machine; of a prior's folder it keeps
what its log says. `write` puts the tables between their markers in README.md: for each stage the choices, their time
and error, the default and why. What was not measured is not there, and nothing is typed by hand but what the stages
are (`tools/speed_table/stages.py`, `model_stages.py`) and, by --of, what was measured on which machine.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from preface.cli.folders import make_folder
from preface.cli.output import exit_status
from preface.cli.usage import Parser
from speed_table import keeping, readme
from speed_table.stages import SCRIPTS

ROOT = Path(__file__).resolve().parents[1]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    common = Parser(add_help=False)
    common.add_argument("--measured", type=Path, default=ROOT / "tools" / "measured", help="what is kept")
    commands = parser.add_subparsers(required=True)
    keep = commands.add_parser("keep", parents=[common], help="keep a measurement")
    keep.add_argument("source", choices=list(SCRIPTS), help="what measured it")
    keep.add_argument("given", type=Path, help="JSON that it wrote; of `training`, the folder of a prior")
    keep.add_argument("--name", default="", help="of this one, where several of a source are kept")
    keep.add_argument("--of", required=True, help="what was measured on which machine, in a few words")
    keep.set_defaults(run=_keep)
    write = commands.add_parser("write", parents=[common], help="write the tables")
    write.add_argument("--readme", type=Path, default=ROOT / "README.md")
    write.set_defaults(run=_write)
    options = parser.parse_args(arguments)
    return exit_status(lambda: options.run(options), parser, parser.prog, lambda: (OSError,))


def _keep(options: argparse.Namespace) -> list[str]:
    make_folder(options.measured)
    path = keeping.keep(options.source, options.name, options.of, options.given, options.measured)
    return [str(path)]


def _write(options: argparse.Namespace) -> list[str]:
    return [str(readme.write(options.readme, keeping.read_kept(options.measured)))]


if __name__ == "__main__":
    sys.exit(main())
