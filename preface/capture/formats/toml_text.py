"""Writing the little TOML that anipose and caliscope read: tables of texts, numbers and lists of numbers.

JSON spells exactly these values as TOML does, floats in the shortest form that reads back bit for bit; a
library for the whole of TOML would be a dependency for ten lines.
"""

import json
from collections.abc import Mapping
from typing import Any


def toml_text(tables: Mapping[str, Mapping[str, Any]]) -> bytes:
    """Spell tables as TOML; table names are of bare keys joined by dots, values JSON scalars and lists."""
    blocks = [
        "\n".join(
            [
                f"[{table}]",
                *(f"{key} = {json.dumps(value, allow_nan=False)}" for key, value in values.items()),
            ]
        )
        for table, values in tables.items()
    ]
    return ("\n\n".join(blocks) + "\n").encode()
