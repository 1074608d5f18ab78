"""Single values of a report: what a caller may pass, how the page shows it, how the JSON twin stores it."""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Value = None | bool | int | float | str

MISSING = "–"
SIGNIFICANT_DIGITS = 4


@dataclass(frozen=True)
class Target:
    """What a figure must reach: ``at_least`` <= value <= ``at_most``, either end may be left open."""

    at_most: float | None = None
    at_least: float | None = None

    def __post_init__(self) -> None:
        ends = [end for end in (self.at_least, self.at_most) if end is not None]
        if not ends or not all(map(math.isfinite, ends)) or ends != sorted(ends):
            raise ValueError(f"a target needs at_most or at_least, finite and in order, not {self}")

    def met_by(self, value: Value) -> bool | None:
        """Whether a number reaches the target; None where there is no number to judge."""
        if not is_number(value) or math.isnan(value):  # type: ignore[arg-type]
            return None
        low = -math.inf if self.at_least is None else self.at_least
        high = math.inf if self.at_most is None else self.at_most
        return low <= value <= high  # type: ignore[operator]

    def __str__(self) -> str:
        parts = [f"≥ {_shown_exact(self.at_least)}"] if self.at_least is not None else []
        parts += [f"≤ {_shown_exact(self.at_most)}"] if self.at_most is not None else []
        return ", ".join(parts)


def plain(value: Any) -> Value:
    """A value as plain Python: numpy scalars and 0-d arrays unwrapped, paths as text.

    Raises:
        TypeError: anything else than a number, text, path, truth value or None.
    """
    if isinstance(value, (np.generic, np.ndarray)) and np.ndim(value) == 0:
        value = value.item()
    if isinstance(value, os.PathLike):
        value = os.fspath(value)
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"a report shows numbers, text, paths, truth values and None, not {type(value).__name__}")


def is_number(value: Value) -> bool:
    """Whether a plain value is a number; truth values are not."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def json_tree(value: Any) -> Any:
    """A tree of mappings, sequences and values as strict JSON holds it.

    NaN becomes null, infinities become the words that ``float`` reads, and lone surrogates, which file
    names may hold and UTF-8 may not, become ``\\udcNN``.
    """
    if isinstance(value, Mapping):
        return {encodable(str(key)): json_tree(item) for key, item in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [json_tree(item) for item in value]
    leaf = plain(value)
    if isinstance(leaf, float) and not math.isfinite(leaf):
        return None if math.isnan(leaf) else ("Infinity" if leaf > 0 else "-Infinity")
    return encodable(leaf) if isinstance(leaf, str) else leaf


def encodable(text: str) -> str:
    """The text with what UTF-8 cannot hold written as an escape."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def shown(value: Value) -> str:
    """A plain value as the page prints it.

    Whole numbers in full with thousands separated, other numbers to four significant digits (but never
    rounded to the left of the decimal point), infinity as ∞, and what is missing as a dash.
    """
    if value is None:
        return MISSING
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str):
        return value
    if isinstance(value, int):
        return f"{value:,}".replace("-", "−")
    return _shown_float(value).replace("-", "−")


def _shown_exact(value: float) -> str:
    """Like :func:`shown`, without the zeros that would claim a measured digit: 0.3, not 0.3000."""
    mantissa, dot, exponent = shown(value).partition("·")
    return (mantissa.rstrip("0").rstrip(".") if "." in mantissa else mantissa) + dot + exponent


def _shown_float(value: float) -> str:
    if math.isnan(value):
        return MISSING
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    if value == 0:
        return "0"
    mantissa, exponent = f"{value:.{SIGNIFICANT_DIGITS - 1}e}".split("e")  # rounds before it counts digits
    if -4 <= int(exponent) < 9:
        return f"{value:,.{max(0, SIGNIFICANT_DIGITS - 1 - int(exponent))}f}"
    superscript = str(int(exponent)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{mantissa}·10{superscript}"
